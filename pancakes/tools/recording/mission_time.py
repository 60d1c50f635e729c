"""A recording's time as the mission's, which is 0 where the mission began. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain, islice
from typing import Final

from pancakes.packet import agent_of
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

AGREE_NS: Final = NANOSECONDS
"""Missions of agents that were begun together may have begun this far apart, in host time."""
ENOUGH: Final = 20
"""So many packets are compared: each is seen a moment after its stamp, and the shortest delay counts."""
MOST: Final = 20_000
"""At most so many packets are looked at."""


def speed_of(about: Mapping[str, str]) -> float:
    """Returns the mission seconds for each second of host time, as a recorder wrote it; 1 where that is no number."""
    try:
        speed = float(about["speed"])
    except (KeyError, ValueError):
        return 1.0
    return speed if 0.0 < speed < math.inf else 1.0


@dataclass(frozen=True)
class MissionTime:
    """What turns a recording's time into mission time.

    Attributes:
        zero_ns: when the mission began, as the recording counts time.
        speed: mission seconds for each second of the recording.
        known: whether it is the mission's time; otherwise seconds since the recording began: the agents' missions did
            not begin together, or not at all.
    """

    zero_ns: int = 0
    speed: float = 1.0
    known: bool = True

    def at(self, time_ns: int) -> float:
        """Returns the mission time in seconds; 0 while the mission was held."""
        return max(0.0, (time_ns - self.zero_ns) / NANOSECONDS * self.speed)

    @property
    def name(self) -> str:
        """What this time is called."""
        return "mission time" if self.known else "time since the recording began"

    @classmethod
    def of(cls, files: Iterable[tuple[Mapping[str, str], Iterable[RecordedPacket]]]) -> MissionTime:
        """Finds the mission time of a recording.

        Where an agent was started again its clock began anew; what counts is its first life.

        Args:
            files: of each file what its recorder wrote about it, complete once its first packet has been taken, and
                its packets.
        """
        begun: dict[str, tuple[int, int, float]] = {}  # by agent: its first packet, its mission's beginning, the speed
        first_ns: int | None = None
        for about, entries in files:
            rest = iter(entries)
            first = next(rest, None)
            if first is None:
                continue
            agent, began_ns = first.agent, first.time_ns
            first_ns = began_ns if first_ns is None else min(first_ns, began_ns)
            speed = speed_of(about)
            zero_ns = _zero_ns(chain((first,), rest), speed)
            if zero_ns is not None and (agent not in begun or began_ns < begun[agent][0]):
                begun[agent] = (began_ns, zero_ns, speed)
        agreed = _agreed([(zero_ns, speed) for _, zero_ns, speed in begun.values()])
        return cls(*agreed) if agreed is not None else cls(first_ns or 0, 1.0, False)


def _zero_ns(entries: Iterable[RecordedPacket], speed: float) -> int | None:
    own = (entry for entry in islice(entries, MOST) if agent_of(entry.packet.source) == entry.agent)
    begun = (entry for entry in own if entry.packet.stamp > 0.0)
    zeros = (entry.time_ns - round(entry.packet.stamp / speed * NANOSECONDS) for entry in begun)
    return min(islice(zeros, ENOUGH), default=None)


def _agreed(begun: list[tuple[int, float]]) -> tuple[int, float] | None:
    """Returns the beginning that more than half of the agents agree on, and the speed."""
    for zero_ns, speed in sorted(begun):
        together = [other for other in begun if other[1] == speed and 0 <= other[0] - zero_ns <= AGREE_NS]
        if 2 * len(together) > len(begun):
            return zero_ns, speed
    return None
