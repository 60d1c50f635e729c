"""Moves discs that may touch something with pymunk, all bodies at a time.

`pymunk.batch` sets and reads all bodies with one call each; one by one, through pymunk's properties and its callback
for velocities, a step of many robots takes far longer. No other file uses that module.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy
import pymunk
from pymunk.batch import BodyFields, Buffer, get_space_bodies, set_space_bodies

from pancakes.bodies.sim.disc import Disc

_WALL_M = 0.05
_PUSH = BodyFields.FORCE | BodyFields.TORQUE
_MOTION = BodyFields.POSITION | BodyFields.ANGLE | BodyFields.VELOCITY | BodyFields.ANGULAR_VELOCITY
WALL = "wall"
"""The name of a wall, where one is run into."""


class Solver:
    """The solid things, as pymunk knows them. Discs are only brought up to date by `unload`.

    Args:
        half_width_m: walls stand at this and at minus this along x.
        half_height_m: the same along y.
        began: takes the names of two things that begin to touch, and where the first is that is no wall.
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
        # Defaults are made for pixels: these say how far bodies sink into each other, in metres, and how fast
        # they are pushed apart again.
        self._space.collision_slop = 0.0002
        self._space.collision_bias = 0.5**100
        # Nothing is left of a velocity after a step, so that what a body is pushed with is its velocity: the one that
        # its wheels or legs ask for. pymunk then takes away what contacts forbid, and moves bodies in the next step.
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
        """Puts a disc among the solid things."""
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
        # A row for each body, in the order in which they were added, and one for that of all that stands.
        rows = len(self._bodies) + 1
        self._asked = numpy.zeros((rows, 4))
        self._pushes = numpy.zeros((rows, 3))
        self._masses = numpy.array([*(body.mass for body in self._bodies), 0.0])
        self._moments = numpy.array([*(body.moment for body in self._bodies), 0.0])
        self._pushed.set_float_buf(self._pushes)

    def load(self) -> None:
        """Takes over where all discs are, and how they move."""
        for disc, body in zip(self._discs, self._bodies, strict=True):
            _place(disc, body)

    def step(self, dt_s: float) -> None:
        """Moves everything by `dt_s`."""
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
        """Tells all discs where they are now, and how they move."""
        for disc, row in zip(self._discs, self._motion().tolist(), strict=False):
            disc.moved(*row)

    def _motion(self) -> Any:
        """Returns position, angle, velocity and turning rate of all bodies, until the next call."""
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
