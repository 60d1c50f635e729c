"""A control task that notes how late it is ticked, beside whatever else its agent does."""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.task import Task, Tick, every


class Steady(Task):
    """Ticks, and tells how late each tick was, in microseconds of host time, between two changes of `window`.

    A tick that never came because the agent stood still counts too, as late as it would have been: otherwise the
    longest delays would be the ones that are told least of.

    Attributes:
        late_s: how late each tick was since the last change of `window`, in seconds.
    """

    @dataclass
    class Settings:
        window: int = 0

    @dataclass
    class State:
        """What was measured; the numbers as one text, which costs nothing when the state is written down."""

        window: int = 0
        late_us: str = ""

    def on_start(self) -> None:
        self.late_s: list[float] = []

    @every(hz=40)
    def tick(self, tick: Tick) -> None:
        """Takes one tick."""
        late_s, speed = self.now() - tick.time_s, self._actor.kernel.mission.speed
        self.late_s.append(late_s / speed)
        for number in range(tick.missed):
            self.late_s.append((late_s + (number + 1) * self._actor.timers["tick"].period_s) / speed)

    def on_settings(self) -> None:
        late_s, self.late_s = self.late_s, []
        self.state.window = self.settings.window
        self.state.late_us = " ".join(str(round(1e6 * one_s)) for one_s in late_s)
