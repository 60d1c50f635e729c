"""What can be turned down: a range for each knob, and where in it the knob stands at a given effort.

*Effort* says how much a robot may do: 1 is all that it is configured for, 0 the least that its mission allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, TypeAlias

from msgspec import Meta

Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
"""From 0 to 1."""
PositiveShare: TypeAlias = Annotated[float, Meta(gt=0, le=1)]
"""Above 0, up to 1."""
Rate: TypeAlias = Annotated[float, Meta(ge=0, le=1000)]
"""Ticks for each second of mission time; 0 rests."""
Duration: TypeAlias = Annotated[float, Meta(gt=0, le=1e9)]
"""Seconds of mission time."""

LEAST_SLEEP_S: Final = 1.0
"""Below this the links cost more to close and open than the sleep saves."""


@dataclass(frozen=True, slots=True)
class Knob:
    """One thing that can be turned: the rate of a task, or one of its settings.

    Attributes:
        target: the task, as `task` or `service/task`.
        key: the name of the setting; empty: the knob is the task's rate.
        timer: for a rate, which time-driven method; empty: the first.
    """

    target: str
    key: str = ""
    timer: str = ""

    def __str__(self) -> str:
        return f"{self.key} of {self.target}" if self.key else f"the rate of {self.target}"


@dataclass
class Range:
    """The range of a knob.

    Attributes:
        full: where it stands at effort 1, and again when the battery has recovered.
        least: where it stands at effort 0. For what costs less when it is larger, such as a period, it is the larger.
        from_effort: it begins to move where the effort falls below this; above, it stands at `full`.
    """

    full: float
    least: float
    from_effort: PositiveShare = 1.0

    def at(self, effort: float) -> float:
        """Returns where the knob stands at an effort."""
        share = _share(effort, self.from_effort)
        return self.full if share == 1.0 else round(self.least + share * (self.full - self.least), 6)


@dataclass
class RateRange(Range):
    """The range of a task's rate.

    Attributes:
        full: its rate at effort 1, in Hz, and again when the battery has recovered.
        least: its rate at effort 0, in Hz; 0 lets it rest.
        from_effort: it begins to fall where the effort falls below this.
        timer: which time-driven method, where the task has several; empty: the first.
    """

    full: Rate
    least: Rate
    timer: str = ""

    def __post_init__(self) -> None:
        if self.least > self.full:
            raise ValueError(f"least = {self.least:g} Hz lies above full = {self.full:g} Hz")


@dataclass
class Sleep:
    """How the Network Service sleeps and wakes in turn.

    Attributes:
        every_s: from the beginning of one sleep to that of the next.
        for_s: how long it sleeps each time at effort 0; less at a higher effort, and below 1 s not at all.
        from_effort: it begins to sleep where the effort falls below this.
    """

    every_s: Duration
    for_s: Duration
    from_effort: PositiveShare = 1.0

    def __post_init__(self) -> None:
        if self.for_s >= self.every_s:
            raise ValueError(f"for_s = {self.for_s:g} leaves no time awake in every_s = {self.every_s:g}")

    def at(self, effort: float) -> float:
        """Returns how long it sleeps each time at an effort, in seconds; 0: not at all."""
        for_s = self.for_s * (1.0 - _share(effort, self.from_effort))
        return round(for_s, 3) if for_s >= LEAST_SLEEP_S else 0.0


def _share(effort: float, from_effort: float) -> float:
    return min(effort / from_effort, 1.0)
