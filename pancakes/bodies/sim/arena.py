"""The solid things of the simulated world: walls, robots, sensor nodes, walking persons.

One actor owns an arena; nothing here is safe to call from several threads. The arena's frame has its origin in
the middle, x to the right and y up.

While no disc is near enough to touch anything, discs coast: each moves by itself, step by step as pymunk would move it,
at a fraction of the cost. Where a disc may touch something, pymunk moves them all.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

from pancakes.bodies.sim.disc import Disc
from pancakes.bodies.sim.rays import Fan
from pancakes.bodies.sim.solver import WALL, Solver

__all__ = ["WALL", "Arena", "Contact"]

_TOUCH_AGAIN_S = 0.5
_ROOM_M: Final = 0.01
"""Discs that have less room than this do not coast."""
_LOOK_AGAIN_S: Final = 0.1
"""The time for which discs do not coast once they could not: checking it takes longer than a step."""
_BY_X = attrgetter("x_m")


@dataclass(frozen=True, slots=True)
class Contact:
    """Two things began to touch.

    Attributes:
        time_s: when.
        names: what they are called, sorted.
        x_m: where the first of them was, if it is no wall, else the other.
        y_m: see `x_m`.
    """

    time_s: float
    names: tuple[str, str]
    x_m: float
    y_m: float


class Arena:
    """A rectangle of floor with walls round it, and the discs in it.

    Args:
        width_m: inner size along x.
        height_m: inner size along y.
    """

    def __init__(self, width_m: float, height_m: float) -> None:
        self.half_width_m = 0.5 * width_m
        self.half_height_m = 0.5 * height_m
        self._solver = Solver(self.half_width_m, self.half_height_m, self._begin, self._separate)
        self._moving: list[Disc] = []
        self._by_x: list[Disc] = []
        self._sorted = False
        self._widest_m = 0.0
        self._room_m = 0.0
        self._coasts = False
        self._look_again_s = 0.0
        self._time_s = 0.0
        self._touching: dict[tuple[str, str], float] = {}
        self._contacts: list[Contact] = []

    def add(
        self, name: str, x_m: float, y_m: float, theta_rad: float, radius_m: float, mass_kg: float = math.inf
    ) -> Disc:
        """Puts a disc into the arena; without a mass it never moves."""
        disc = Disc(name, radius_m, x_m, y_m, theta_rad, mass_kg)
        self._solver.add(disc)
        if not math.isinf(mass_kg):
            self._moving.append(disc)
        self._by_x.append(disc)
        self._widest_m = max(self._widest_m, radius_m)
        self._sorted = False
        self._room_m = self._look_again_s = 0.0
        return disc

    def step(self, time_s: float, dt_s: float, steps: int = 1) -> None:
        """Moves everything by so many steps of `dt_s`, the first of which ends at `time_s`."""
        self._sorted = False
        if self._can_coast(time_s, steps * dt_s):
            for disc in self._moving:
                disc.coast(steps, dt_s)
            return
        for step in range(steps):
            self._time_s = time_s + step * dt_s
            self._solver.step(dt_s)
        self._solver.unload()

    def _can_coast(self, time_s: float, for_s: float) -> bool:
        """Returns whether nothing can touch anything in the next `for_s`; makes ready for that, or for the other."""
        if time_s < self._look_again_s:
            return False
        top_mps = 0.0
        for disc in self._moving:
            if disc.top_mps > top_mps:
                top_mps = disc.top_mps
        way_m = for_s * top_mps
        if way_m > self._room_m:
            self._room_m = self._measure_room_m()
        self._room_m -= way_m
        can = self._room_m > 0.0
        if not can:
            self._room_m = 0.0
            self._look_again_s = time_s + _LOOK_AGAIN_S
            if self._coasts:
                self._solver.load()
        self._coasts = can
        return can

    def _measure_room_m(self) -> float:
        """Returns how far every disc can go before any of them may touch something; 0 where that is little."""
        room_m = math.inf
        by_x = self._discs_by_x()
        for index, disc in enumerate(by_x):
            x_m, y_m, radius_m = disc.x_m, disc.y_m, disc.radius_m
            if not math.isinf(disc.mass_kg):
                wall_m = min(self.half_width_m - abs(x_m), self.half_height_m - abs(y_m)) - radius_m
                room_m = min(room_m, wall_m)
            for other in by_x[index + 1 :]:
                aside_m = other.x_m - x_m - radius_m
                if aside_m - self._widest_m > 2 * room_m:
                    break
                gap_m = math.hypot(other.x_m - x_m, other.y_m - y_m) - radius_m - other.radius_m
                if gap_m < 2 * room_m and not (math.isinf(disc.mass_kg) and math.isinf(other.mass_kg)):
                    room_m = 0.5 * gap_m
            if room_m < _ROOM_M:
                return 0.0
        return room_m - _ROOM_M

    def _discs_by_x(self) -> list[Disc]:
        if not self._sorted:
            self._by_x.sort(key=_BY_X)
            self._sorted = True
        return self._by_x

    def take_contacts(self) -> list[Contact]:
        """Returns the contacts that began since the last call."""
        contacts, self._contacts = self._contacts, []
        return contacts

    def inside(self, disc: Disc) -> bool:
        """Returns whether a disc's centre lies within the walls."""
        return abs(disc.x_m) <= self.half_width_m and abs(disc.y_m) <= self.half_height_m

    def ranges(self, disc: Disc, fan: Fan) -> list[float]:
        """Casts the rays of a ring of sensors on a disc.

        Returns:
            For each sensor the distance to the nearest thing in its cone, infinity where there is none.
        """
        by_x = self._discs_by_x()
        reach_m = fan.reach_m + self._widest_m
        first = bisect_left(by_x, disc.x_m - reach_m, key=_BY_X)
        behind = bisect_left(by_x, disc.x_m + reach_m, first, key=_BY_X)
        return fan.ranges(disc, by_x[first:behind], self.half_width_m, self.half_height_m)

    def _begin(self, pair: tuple[str, str], place: tuple[float, float]) -> None:
        # Solid bodies that press against each other part and touch again and again: that is one contact.
        last_s = self._touching.get(pair, -math.inf)
        self._touching[pair] = self._time_s
        if self._time_s - last_s >= _TOUCH_AGAIN_S:
            self._contacts.append(Contact(self._time_s, pair, *place))

    def _separate(self, pair: tuple[str, str]) -> None:
        self._touching[pair] = self._time_s
