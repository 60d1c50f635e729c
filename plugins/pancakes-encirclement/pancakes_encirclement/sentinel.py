"""`Sentinel`: start a task when motion is reported (paper §2, Figure 1)."""

from __future__ import annotations

from dataclasses import dataclass

from pancakes import LOG, SYSCTRL, SYSTEM, Packet, Task, agent_of, on
from pancakes.control import Reply, Start
from pancakes.events import Event
from pancakes_encirclement.packets import MotionDetected

ENDINGS = ("task_stopped", "task_given_up")


class Sentinel(Task):
    """Start a task of its own agent with a control packet at the first report of motion.

    The place of that report is set as the task's `centre_m`. If the task has ended, the next report starts it again.
    Event: `alarm`.
    """

    @dataclass
    class Settings:
        """What to start.

        Attributes:
            target: the task, as `service/task`.
        """

        target: str = "client/ScanTarget"

    settings: Settings

    def on_start(self) -> None:
        self._asked: int | None = None
        self._running = False

    @on(SYSTEM, MotionDetected)
    def reported(self, packet: Packet) -> None:
        """Take a report."""
        if self._running or self._asked is not None:
            return
        place = (packet.body.x_m, packet.body.y_m)
        self.event("alarm", x_m=place[0], y_m=place[1], told_by=agent_of(packet.source), starts=self.settings.target)
        self._asked = self.publish(SYSCTRL, Start(self.settings.target, {"centre_m": list(place)})).seq

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Take the reply: whether the task was started."""
        if packet.cause is None or packet.cause[1] != self._asked:
            return
        self._asked = None
        self._running = packet.body.ok
        if not packet.body.ok:
            self.log("warning", f"{self.settings.target} was not started: {packet.body.reason}")

    @on(LOG, Event)
    def happened(self, packet: Packet) -> None:
        """Note that the task has ended."""
        event: Event = packet.body
        if event.kind in ENDINGS and agent_of(packet.source) == self.agent:
            if event.fields.get("task") == self.settings.target.rpartition("/")[2]:
                self._running = False
