"""`DutyCycle`: sense and talk less while nothing happens, and more as soon as something does (paper §3.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pancakes import LOG, SYSCTRL, SYSTEM, NotNegative, Packet, Positive, Task, agent_of, on
from pancakes.control import Describe, Reply, Reschedule, Start, Stop
from pancakes.events import Event
from pancakes.kernel.timer import OneShot
from pancakes.packet import join
from pancakes_sensor_field.drivers import PeriodS
from pancakes_sensor_field.duty import Duty
from pancakes_sensor_field.packets import Activity, AlarmRaised, ReportPeriod

NETWORK = "network"
SETTLING_S = 1.0
"""While the agent starts, its tasks cannot be rescheduled yet."""


@dataclass
class Rates:
    """The rates of a task.

    Attributes:
        quiet_hz: while nothing happens.
        busy_hz: while something does.
    """

    quiet_hz: NotNegative
    busy_hz: NotNegative


@dataclass
class Periods:
    """The report periods of the tiny nodes on a line.

    Attributes:
        quiet_s: while nothing happens.
        busy_s: while something does.
    """

    quiet_s: PeriodS
    busy_s: PeriodS


class DutyCycle(Task):
    """Save an agent's power with control packets that any client could send.

    While nothing happens, tasks and devices run at their low rates, tiny nodes report seldom, and the Network Service
    sleeps most of the time. When something does (`sensor_field.activity` of a task here, or an alarm), all of that ends
    at once, until `linger_s` after it is over. Event: `duty`.
    """

    @dataclass
    class Settings:
        """What to turn down.

        Attributes:
            rates: by target, as `service/task`: `device/motion`, `client/Watch`, `network/Discovery`.
            lines: by device: the report periods of the tiny nodes on each line.
            linger_s: how long everything stays awake after the last event.
            sleep_s: how long the Network Service sleeps at a time; 0: never.
            awake_s: how long it is awake in between.
            hosts: tasks that must stay in reach: while one of them runs here, the Network Service does not sleep.
        """

        rates: dict[str, Rates] = field(default_factory=dict)
        lines: dict[str, Periods] = field(default_factory=dict)
        linger_s: Positive = 15.0
        sleep_s: NotNegative = 0.0
        awake_s: Positive = 3.0
        hosts: list[str] = field(default_factory=list)

    settings: Settings

    def on_start(self) -> None:
        self._duty = Duty(self.settings.linger_s)
        self._asked: dict[int, str] = {}
        self._describe = 0
        self._asleep = False
        self._nap: OneShot | None = None
        self._look: OneShot | None = None
        self.after(SETTLING_S, self._apply)

    def on_settings(self) -> None:
        self._duty.linger_s = self.settings.linger_s
        self._apply()

    # What happens ----------------------------------------------------------------------------------------------

    @on(SYSTEM, Activity)
    def happens(self, packet: Packet) -> None:
        """Take a report that something happens at a node here, or no longer does."""
        if agent_of(packet.source) == self.agent:
            self._duty.noticed(packet.body.node, packet.body.busy, self.now())
            self._decide(packet.body.node)

    @on(SYSTEM, AlarmRaised)
    def alarmed(self, packet: Packet) -> None:
        """Take an alarm, which is repeated while it lasts."""
        self._duty.stirred(self.now())
        self._decide(f"alarm {packet.body.number}")

    @on(LOG, Event)
    def told(self, packet: Packet) -> None:
        """Note when the Network Service sleeps or wakes, and when a task arrives that must stay in reach."""
        event: Event = packet.body
        if agent_of(packet.source) != self.agent:
            return
        if event.fields.get("service") == NETWORK and event.kind in ("service_started", "service_stopped"):
            self._asleep = event.kind == "service_stopped"
            self._rest_later()
        elif event.kind == "task_started" and event.fields.get("task") in self.settings.hosts:
            self._wake()

    # What is done about it -------------------------------------------------------------------------------------

    def _decide(self, because: str = "") -> None:
        """Decide whether the node is busy now, and when to check again."""
        if self._duty.decide(self.now()):
            self.event("duty", busy=self._duty.busy, because=because or "nothing happens")
            self._apply()
        if self._look is not None:
            self._look.cancel()
            self._look = None
        calm_in_s = self._duty.calm_in(self.now())
        if calm_in_s is not None:
            self._look = self.after(calm_in_s, self._decide)

    def _apply(self) -> None:
        """Set all rates, and let the network sleep or wake."""
        busy = self._duty.busy
        for target, rates in self.settings.rates.items():
            self._ask(Reschedule(target, rates.busy_hz if busy else rates.quiet_hz), target)
        for line, periods in self.settings.lines.items():
            period = ReportPeriod(periods.busy_s if busy else periods.quiet_s)
            self.publish(SYSTEM, period, to=join(self.agent, "device", line))
        if busy:
            self._wake()
        else:
            self._rest_later()

    def _wake(self) -> None:
        if self._nap is not None:
            self._nap.cancel()
            self._nap = None
        if self._asleep:
            self._asleep = False
            self._ask(Start(NETWORK), NETWORK)

    def _rest_later(self) -> None:
        """Let the network sleep after a while, if it still may then."""
        if self._nap is not None:
            self._nap.cancel()
            self._nap = None
        if self.settings.sleep_s and not self._duty.busy and not self._asleep:
            self._nap = self.after(self.settings.awake_s, self._look_who_is_here)

    def _look_who_is_here(self) -> None:
        self._nap = None
        self._describe = self.publish(SYSCTRL, Describe()).seq

    def _rest(self, description: Any) -> None:
        here = [task["task"] for task in description["tasks"] if task["state"] == "running"]
        if any(task in here for task in self.settings.hosts):
            self._rest_later()
        elif self.settings.sleep_s and not self._duty.busy and not self._asleep:
            self._ask(Stop(NETWORK, for_s=self.settings.sleep_s), NETWORK)

    # Replies ---------------------------------------------------------------------------------------------------

    def _ask(self, body: Any, target: str) -> None:
        self._asked[self.publish(SYSCTRL, body).seq] = target

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Take the replies, and log what could not be done."""
        seq = packet.cause[1] if packet.cause is not None else 0
        reply: Reply = packet.body
        if seq == self._describe and reply.ok:
            self._rest(reply.result)
            return
        target = self._asked.pop(seq, None)
        if target is None or reply.ok:
            return
        if target == NETWORK:
            # It refuses while a task migrates, or it has woken up by itself meanwhile: both pass.
            self.log("debug", f"the network did not change: {reply.reason}")
            self._rest_later()
        else:
            self.log("warning", f"{target} did not change its rate: {reply.reason}")
