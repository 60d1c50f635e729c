"""What the processor time of an agent goes to, turn by turn, while something wants to know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

NOTHING: Final = (0, 0.0, 0.0)


class MeterReading(msgspec.Struct, frozen=True):
    """What was counted up to some moment.

    Attributes:
        turns: by actor: how many turns, and their processor time in seconds.
        ticks: by actor and time-driven method: how many ticks, their processor time, and the sum of its squares.
    """

    turns: Mapping[str, tuple[int, float]]
    ticks: Mapping[tuple[str, str], tuple[int, float, float]]


class TurnMeter:
    """Counts the processor time of turns and ticks.

    Each is entered by the thread that gives the turn. An actor has one turn at a time, so of each entry there is one
    writer; entries are replaced whole, so a reader in another thread sees none that is half done.
    """

    def __init__(self) -> None:
        self._turns: dict[str, tuple[int, float]] = {}
        self._ticks: dict[tuple[str, str], tuple[int, float, float]] = {}

    def turn(self, address: str, used_s: float) -> None:
        """A turn of an actor has ended, which took so much processor time."""
        count, sum_s = self._turns.get(address, (0, 0.0))
        self._turns[address] = (count + 1, sum_s + used_s)

    def tick(self, address: str, method: str, used_s: float) -> None:
        """A tick of an actor has ended, within its turn."""
        count, sum_s, squares = self._ticks.get((address, method), NOTHING)
        self._ticks[(address, method)] = (count + 1, sum_s + used_s, squares + used_s * used_s)

    def read(self) -> MeterReading:
        """Returns what was counted so far. Any thread."""
        return MeterReading(self._turns.copy(), self._ticks.copy())
