"""`BatteryWatchdog`: talk less when the battery runs low (paper §3.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from pancakes import SYSCTRL, SYSTEM, NotNegative, Packet, Task, on
from pancakes.control import Reply, Reschedule
from pancakes.devices import Battery

CHARGED_ABOVE = 0.02
"""The battery must rise this far above the threshold before falling below it counts again."""


class BatteryWatchdog(Task):
    """Slow down other tasks with control packets when the battery falls below a level. Event: `saving_power`."""

    requires = ("battery",)

    @dataclass
    class Settings:
        """At which level to slow down which tasks.

        Attributes:
            below: the level, as a share of the battery's range.
            slow: the new rate of each task that is slowed down, in Hz, by `service/task`.
        """

        below: Annotated[float, Meta(gt=0, lt=1)] = 0.90
        slow: dict[str, NotNegative] = field(default_factory=dict)

    @dataclass
    class State:
        """The state that outlives a restart.

        Attributes:
            saving: whether the battery has fallen below the level, and the tasks were slowed down.
        """

        saving: bool = False

    settings: Settings
    state: State

    def on_start(self) -> None:
        self._asked: dict[int, str] = {}

    @on(SYSTEM, Battery, queue="latest")
    def measured(self, packet: Packet) -> None:
        """Take a reading of the battery."""
        level = packet.body.level
        if self.state.saving:
            self.state.saving = level < self.settings.below + CHARGED_ABOVE
        elif level < self.settings.below:
            self.state.saving = True
            self.event("saving_power", level=level, slow=dict(self.settings.slow))
            for target, rate_hz in self.settings.slow.items():
                request = self.publish(SYSCTRL, Reschedule(target, rate_hz))
                self._asked[request.seq] = target

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Say what could not be slowed down, and why."""
        target = self._asked.pop(packet.cause[1], None) if packet.cause is not None else None
        if target is not None and not packet.body.ok:
            self.log("warning", f"{target} was not slowed down: {packet.body.reason}")
