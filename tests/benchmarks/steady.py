"""A control task that notes how late it is ticked, beside whatever else its agent does."""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.task import Task, Tick, every


class Steady(Task):
    """Ticks, and tells percentiles of its lateness, in host time, of the time between two changes of `window`."""

    @dataclass
    class Settings:
        window: int = 0

    @dataclass
    class State:
        window: int = 0
        ticks: int = 0
        p50_us: float = 0.0
        p99_us: float = 0.0

    def on_start(self) -> None:
        self._late_s: list[float] = []

    @every(hz=20)
    def tick(self, tick: Tick) -> None:
        """Takes one tick."""
        self._late_s.append((self.now() - tick.time_s) / self.kernel.mission.speed)

    def on_settings(self) -> None:
        late_s, self._late_s = sorted(self._late_s), []
        self.state.window, self.state.ticks = self.settings.window, len(late_s)
        if late_s:
            self.state.p50_us = late_s[len(late_s) // 2] * 1e6
            self.state.p99_us = late_s[int(len(late_s) * 0.99)] * 1e6
