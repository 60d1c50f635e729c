"""`Watch`: read the sensors of one node, and report to the alarm (paper §2, the sensor node's part)."""

from __future__ import annotations

from dataclasses import dataclass, field

from pancakes import SYSTEM, Packet, Task, Tick, every, on, task_address
from pancakes.devices import Motion, Temperature
from pancakes.errors import MailboxFullError
from pancakes.packet import join
from pancakes_sensor_field.packets import Activity, Report


class Watch(Task):
    """Report one node's temperature and motion to the alarm, wherever the alarm task is now.

    It reports at its rate, and at once when something begins or ceases to move, or to be warm. Reports wait on this
    agent while its network sleeps. It publishes `sensor_field.activity` on its own agent, so that other tasks can save
    power. The sensors may be this agent's own, or virtual devices for a tiny node.
    """

    requires = ("temperature", "motion")

    @dataclass
    class Settings:
        """The devices that it watches.

        Attributes:
            alarm: the identity of the alarm task: its birthplace and its name there.
            node: the node's name in reports; empty: this agent's.
            temperature: name of the device that has its temperature.
            motion: name of the device that senses motion.
            warm_c: from this temperature on, something is happening.
        """

        alarm: str = field(kw_only=True)
        node: str = ""
        temperature: str = "temperature"
        motion: str = "motion"
        warm_c: float = 30.0

    @dataclass
    class State:
        """The state that outlives a restart.

        Attributes:
            reports: the number of its reports.
        """

        reports: int = 0

    settings: Settings
    state: State

    def on_start(self) -> None:
        self._celsius: float | None = None
        self._moving = False
        self._warm = False
        self._busy = False
        self._full = False

    @on(SYSTEM, Temperature)
    def measured(self, packet: Packet) -> None:
        """Take a temperature."""
        if packet.source == join(self.agent, "device", self.settings.temperature):
            self._celsius = packet.body.celsius
            self._look(self._moving, packet.body.celsius >= self.settings.warm_c)

    @on(SYSTEM, Motion)
    def sensed(self, packet: Packet) -> None:
        """Take a reading of the motion sensor."""
        if packet.source == join(self.agent, "device", self.settings.motion):
            self._look(packet.body.detected, self._warm)

    def _look(self, moving: bool, warm: bool) -> None:
        if (moving, warm) == (self._moving, self._warm):
            return
        self._moving, self._warm = moving, warm
        busy = moving or warm
        if busy != self._busy:
            self._busy = busy
            self.publish(SYSTEM, Activity(self._node(), busy))
        self._report()

    @every(hz=0.1)
    def tell(self, tick: Tick) -> None:
        """Report the present readings."""
        if self._celsius is not None:
            self._report()

    def _report(self) -> None:
        report = Report(self._node(), self.state.reports + 1, self._celsius, self._moving)
        try:
            self.publish(SYSTEM, report, to=task_address(self.settings.alarm))
        except MailboxFullError as error:
            if not self._full:
                self._full = True
                self.log("warning", f"reports of {report.node} are not made: {error}")
            return
        self._full = False
        self.state.reports += 1

    def _node(self) -> str:
        return self.settings.node or self.agent
