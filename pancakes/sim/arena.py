"""The arena: move solid discs among walls (pymunk), report collisions, and find what range sensors may see.

While no disc is near enough to touch anything, discs coast: each moves by itself, step by step as pymunk would move it,
at a fraction of the cost. If a disc may touch something, pymunk moves all of them. `pymunk.batch` sets and reads all
bodies with one call each; through pymunk's properties and its callback for velocities, a step of many robots takes far
longer. Rays of sensors are in `rays.py`.

One actor owns an arena; nothing here is thread-safe. The origin is in the middle, x to the right and y up.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final, Literal

import numpy
import pymunk
from pymunk.batch import BodyFields, Buffer, get_space_bodies, set_space_bodies

from pancakes.sim.bodies import Disc
from pancakes.sim.rays import Fan

__all__ = ["Arena", "Incident", "WALL"]


_WALL_M = 0.05
_PUSH = BodyFields.FORCE | BodyFields.TORQUE
_MOTION = BodyFields.POSITION | BodyFields.ANGLE | BodyFields.VELOCITY | BodyFields.ANGULAR_VELOCITY
WALL = "wall"
"""The name of a wall in a collision."""


class Solver:
    """The solid things in pymunk. Only `unload` updates the discs.

    Args:
        half_width_m: walls stand at this and at minus this along x.
        half_height_m: the same along y.
        began: takes the names of two things that begin to touch, and the position of the first that is not a wall.
        ended: takes the names of two things that part.
    """

    def __init__(
        self,
        half_width_m: float,
        half_height_m: float,
        began: Callable[[tuple[str, str], tuple[float, float]], None],
        ended: Callable[[tuple[str, str]], None],
    ) -> None:
        self._space = pymunk.Space()
        # The defaults are made for pixels. These set how far bodies sink into each other, in metres, and how fast they
        # are pushed apart again.
        self._space.collision_slop = 0.0002
        self._space.collision_bias = 0.5**100
        # A step keeps nothing of a velocity, so a body's force is its velocity: the one that its wheels or legs ask
        # for. pymunk then removes what contacts forbid, and moves bodies in the next step.
        self._space.damping = 0.0
        self._space.on_collision(None, None, begin=self._begin, separate=self._separate)
        self._began, self._ended = began, ended
        self._names: dict[pymunk.Shape, str] = {}
        self._discs: list[Disc] = []
        self._bodies: list[pymunk.Body] = []
        self._read = Buffer()
        self._pushed = Buffer()
        self._build_walls(half_width_m + _WALL_M, half_height_m + _WALL_M)
        self._make_room()

    def _build_walls(self, x_m: float, y_m: float) -> None:
        corners = ((-x_m, -y_m), (x_m, -y_m), (x_m, y_m), (-x_m, y_m))
        for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
            wall = pymunk.Segment(self._space.static_body, start, end, _WALL_M)
            self._names[wall] = WALL
            self._space.add(wall)

    def add(self, disc: Disc) -> None:
        """Put a disc among the solid things."""
        if math.isinf(disc.mass_kg):
            shape = pymunk.Circle(self._space.static_body, disc.radius_m, disc.position)
            self._space.add(shape)
        else:
            body = pymunk.Body(disc.mass_kg, pymunk.moment_for_circle(disc.mass_kg, 0.0, disc.radius_m))
            _place(disc, body)
            shape = pymunk.Circle(body, disc.radius_m)
            self._space.add(body, shape)
            self._bodies.append(body)
            self._discs.append(disc)
            self._make_room()
        self._names[shape] = disc.name

    def _make_room(self) -> None:
        # A row for each body, in the order in which they were added, and one for the static body.
        rows = len(self._bodies) + 1
        self._asked = numpy.zeros((rows, 4))
        self._pushes = numpy.zeros((rows, 3))
        self._masses = numpy.array([*(body.mass for body in self._bodies), 0.0])
        self._moments = numpy.array([*(body.moment for body in self._bodies), 0.0])
        self._pushed.set_float_buf(self._pushes)

    def load(self) -> None:
        """Read positions and velocities of all discs."""
        for disc, body in zip(self._discs, self._bodies, strict=True):
            _place(disc, body)

    def step(self, dt_s: float) -> None:
        """Move everything by `dt_s`."""
        if self._discs:
            self._asked[:-1] = [disc.asked_for() for disc in self._discs]
        forward_mps, omega_radps, walks = self._asked[:, 0], self._asked[:, 1], self._asked[:, 2:]
        motion = self._motion()
        # pymunk turns bodies first, and gives them their velocity then. The chord of the arc that the next step makes
        # points along the heading in the middle of that step.
        middle_rad = motion[:, 2] + dt_s * (motion[:, 5] + 0.5 * omega_radps)
        pushes = self._pushes
        pushes[:, 0] = forward_mps * numpy.cos(middle_rad)
        pushes[:, 1] = forward_mps * numpy.sin(middle_rad)
        pushes[:, :2] += walks
        pushes[:, :2] *= (self._masses / dt_s)[:, None]
        pushes[:, 2] = omega_radps * self._moments / dt_s
        set_space_bodies(self._space, _PUSH, self._pushed)
        self._space.step(dt_s)

    def unload(self) -> None:
        """Write positions and velocities back to all discs."""
        for disc, row in zip(self._discs, self._motion().tolist(), strict=False):
            disc.moved(*row)

    def _motion(self) -> Any:
        """Return position, angle, velocity and turning rate of all bodies, until the next call."""
        self._read.clear()
        get_space_bodies(self._space, _MOTION, self._read)
        return numpy.frombuffer(self._read.float_buf()).reshape(-1, 6)

    def _pair(self, arbiter: pymunk.Arbiter) -> tuple[str, str]:
        first, second = sorted(self._names[shape] for shape in arbiter.shapes)
        return first, second

    def _begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        places = {
            self._names[shape]: shape.body.local_to_world(shape.offset)
            for shape in arbiter.shapes
            if isinstance(shape, pymunk.Circle) and shape.body is not None
        }
        pair = self._pair(arbiter)
        place = next(places[name] for name in pair if name in places)
        self._began(pair, (place.x, place.y))

    def _separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        self._ended(self._pair(arbiter))


def _place(disc: Disc, body: pymunk.Body) -> None:
    body.position = disc.position
    body.angle = disc.angle_rad
    body.velocity = disc.velocity
    body.angular_velocity = disc.turning_radps


_TOUCH_AGAIN_S = 0.5
_ROOM_M: Final = 0.01
"""Discs that have less room than this do not coast."""
_LOOK_AGAIN_S: Final = 0.1
"""The time for which discs do not coast once they could not: checking it takes longer than a step."""
_BY_X = attrgetter("x_m")


@dataclass(frozen=True, slots=True)
class Incident:
    """Something that must not happen in an arena.

    Attributes:
        kind: `collision` or `out_of_bounds`.
        time_s: mission time.
        names: the bodies that were part of it, sorted; a wall is called `wall`.
        x_m: where; for a collision, the place of the first body that is not a wall.
        y_m: see `x_m`.
    """

    kind: Literal["collision", "out_of_bounds"]
    time_s: float
    names: tuple[str, ...]
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
        self._collisions: list[Incident] = []

    def add(
        self, name: str, x_m: float, y_m: float, theta_rad: float, radius_m: float, mass_kg: float = math.inf
    ) -> Disc:
        """Put a disc into the arena; without a mass it never moves."""
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
        """Move everything by `steps` steps of `dt_s`; the first ends at `time_s`."""
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
        """Return whether nothing can touch anything in the next `for_s`; prepares for that, or for the solver."""
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
        """Return how far every disc can go before any of them may touch something; 0 if that is little."""
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

    def take_collisions(self) -> list[Incident]:
        """Return the collisions that began since the last call."""
        collisions, self._collisions = self._collisions, []
        return collisions

    def inside(self, disc: Disc) -> bool:
        """Return whether a disc's centre lies within the walls."""
        return abs(disc.x_m) <= self.half_width_m and abs(disc.y_m) <= self.half_height_m

    def ranges(self, disc: Disc, fan: Fan) -> list[float]:
        """Cast the rays of a ring of sensors on a disc.

        Returns:
            For each sensor the distance to the nearest thing in its cone, infinity if the cone is free.
        """
        by_x = self._discs_by_x()
        reach_m = fan.reach_m + self._widest_m
        first = bisect_left(by_x, disc.x_m - reach_m, key=_BY_X)
        behind = bisect_left(by_x, disc.x_m + reach_m, first, key=_BY_X)
        return fan.ranges(disc, by_x[first:behind], self.half_width_m, self.half_height_m)

    def _begin(self, pair: tuple[str, str], place: tuple[float, float]) -> None:
        # Solid bodies that press against each other part and touch again and again: that is one collision.
        last_s = self._touching.get(pair, -math.inf)
        self._touching[pair] = self._time_s
        if self._time_s - last_s >= _TOUCH_AGAIN_S:
            self._collisions.append(Incident("collision", self._time_s, pair, *place))

    def _separate(self, pair: tuple[str, str]) -> None:
        self._touching[pair] = self._time_s
