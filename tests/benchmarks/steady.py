"""A control task that notes how late it is ticked, beside whatever else its agent does."""

from __future__ import annotations

from dataclasses import dataclass, field

from pancakes.task import Task, Tick, every


class Steady(Task):
    """Ticks, and tells how late each tick was, in microseconds of host time, between two changes of `window`."""

    @dataclass
    class Settings:
        window: int = 0

    @dataclass
    class State:
        window: int = 0
        late_us: list[int] = field(default_factory=list)

    def on_start(self) -> None:
        self._late_s: list[float] = []

    @every(hz=40)
    def tick(self, tick: Tick) -> None:
        """Takes one tick."""
        self._late_s.append((self.now() - tick.time_s) / self.kernel.mission.speed)

    def on_settings(self) -> None:
        late_s, self._late_s = self._late_s, []
        self.state.window = self.settings.window
        self.state.late_us = [round(1e6 * one_s) for one_s in late_s]
