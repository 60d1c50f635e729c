"""The solid things of the simulated world: walls, robots, a sensor node, somebody who walks (pymunk).

One actor owns an arena; nothing here is safe to call from several threads. The arena's frame has its origin in
the middle, x to the right and y up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pymunk

from pancakes.sim.robot import RangeSensor

_WALL_M = 0.05
_TOUCH_AGAIN_S = 0.5
_INSET_M = 0.05
WALL = "wall"
"""The name of a wall, where one is run into."""


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


class Disc:
    """A round body.

    One that moves is told its velocity; contacts then take from that what would bring it into something solid.

    Attributes:
        name: what it is called.
        radius_m: its size.
    """

    def __init__(self, name: str, radius_m: float, body: pymunk.Body, shape_filter: pymunk.ShapeFilter) -> None:
        self.name = name
        self.radius_m = radius_m
        self.filter = shape_filter
        self._body = body
        self._forward_mps = 0.0
        self._omega_radps = 0.0
        self._walk: tuple[float, float] | None = None
        self._lead_s = 0.0
        self._theta_rad = body.angle

    def roll(self, v_mps: float, omega_radps: float) -> None:
        """Moves along its heading from now on, turning at `omega_radps`."""
        self._forward_mps, self._omega_radps, self._walk = v_mps, omega_radps, None

    def walk(self, vx_mps: float, vy_mps: float) -> None:
        """Moves with a velocity along the arena's axes from now on, and looks where it goes."""
        self._walk = (vx_mps, vy_mps)
        if vx_mps or vy_mps:
            self._theta_rad = math.atan2(vy_mps, vx_mps)

    @property
    def position(self) -> tuple[float, float]:
        at = self._body.position
        return at.x, at.y

    @property
    def velocity(self) -> tuple[float, float]:
        """Its true velocity along the arena's axes, in m/s."""
        velocity = self._body.velocity
        return velocity.x, velocity.y

    @property
    def theta_rad(self) -> float:
        """Its heading, in (-pi, pi]."""
        theta_rad = self._theta_rad if self._walk is not None else self._body.angle
        return math.pi - (math.pi - theta_rad) % math.tau

    @property
    def v_mps(self) -> float:
        """Its true speed along its heading."""
        vx_mps, vy_mps = self.velocity
        theta_rad = self.theta_rad
        return vx_mps * math.cos(theta_rad) + vy_mps * math.sin(theta_rad)

    @property
    def omega_radps(self) -> float:
        """Its true turning rate."""
        return 0.0 if self._walk is not None else self._body.angular_velocity

    def set_velocity(self, body: pymunk.Body, gravity: Any, damping: float, dt_s: float) -> None:
        """Gives the body the velocity that its wheels or legs ask for; pymunk calls this in each step.

        pymunk moves bodies by it in the next step only, after it has taken away what contacts forbid.
        """
        if self._walk is not None:
            body.velocity = self._walk
            body.angular_velocity = 0.0
            return
        # The chord of the arc that the next step makes points along the heading in the middle of that step.
        middle_rad = body.angle + 0.5 * self._omega_radps * dt_s
        forward_mps = self._forward_mps
        body.velocity = (forward_mps * math.cos(middle_rad), forward_mps * math.sin(middle_rad))
        body.angular_velocity = self._omega_radps


class Arena:
    """A rectangle of floor with walls round it, and the discs in it.

    Args:
        width_m: inner size along x.
        height_m: inner size along y.
    """

    def __init__(self, width_m: float, height_m: float) -> None:
        self.half_width_m = 0.5 * width_m
        self.half_height_m = 0.5 * height_m
        self._space = pymunk.Space()
        # Defaults are made for pixels: these say how far bodies sink into each other, in metres, and how fast
        # they come out again.
        self._space.collision_slop = 0.0002
        self._space.collision_bias = 0.5**100
        self._space.on_collision(None, None, begin=self._begin, separate=self._separate)
        self._names: dict[pymunk.Shape, str] = {}
        self._discs: dict[str, Disc] = {}
        self._time_s = 0.0
        self._touching: dict[tuple[str, str], float] = {}
        self._contacts: list[Contact] = []
        self._build_walls()

    def _build_walls(self) -> None:
        x_m, y_m = self.half_width_m + _WALL_M, self.half_height_m + _WALL_M
        corners = ((-x_m, -y_m), (x_m, -y_m), (x_m, y_m), (-x_m, y_m))
        for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
            wall = pymunk.Segment(self._space.static_body, start, end, _WALL_M)
            self._names[wall] = WALL
            self._space.add(wall)

    def add(
        self, name: str, x_m: float, y_m: float, theta_rad: float, radius_m: float, mass_kg: float = math.inf
    ) -> Disc:
        """Puts a disc into the arena; without a mass it stands there for good."""
        if math.isinf(mass_kg):
            body = pymunk.Body(body_type=pymunk.Body.STATIC)
        else:
            body = pymunk.Body(mass_kg, pymunk.moment_for_circle(mass_kg, 0.0, radius_m))
        body.position = (x_m, y_m)
        body.angle = theta_rad
        shape = pymunk.Circle(body, radius_m)
        shape.filter = pymunk.ShapeFilter(group=len(self._discs) + 1)
        disc = Disc(name, radius_m, body, shape.filter)
        if not math.isinf(mass_kg):
            body.velocity_func = disc.set_velocity
        self._space.add(body, shape)
        self._names[shape] = name
        self._discs[name] = disc
        return disc

    def step(self, time_s: float, dt_s: float) -> None:
        """Moves everything by `dt_s`, up to `time_s`."""
        self._time_s = time_s
        self._space.step(dt_s)

    def take_contacts(self) -> list[Contact]:
        """Returns the contacts that began since the last call."""
        contacts, self._contacts = self._contacts, []
        return contacts

    def inside(self, disc: Disc) -> bool:
        """Returns whether a disc's centre lies within the walls."""
        x_m, y_m = disc.position
        return abs(x_m) <= self.half_width_m and abs(y_m) <= self.half_height_m

    def ranges(
        self, disc: Disc, sensors: Sequence[RangeSensor], cone_rad: float, rays: int, max_range_m: float
    ) -> list[float]:
        """Casts the rays of a ring of sensors on a disc.

        Args:
            disc: what carries the sensors; it does not see itself.
            sensors: where they sit and look.
            cone_rad: how wide each one sees.
            rays: how many rays, spread evenly over the cone, stand for it.
            max_range_m: how far a ray reaches.

        Returns:
            For each sensor the distance to the nearest thing in its cone, infinity where there is none.
        """
        space, shape_filter = self._space, disc.filter
        x_m, y_m = disc.position
        theta_rad = disc.theta_rad
        reach_m = max_range_m + max(math.hypot(sensor.x_m, sensor.y_m) for sensor in sensors)
        if space.point_query_nearest((x_m, y_m), reach_m, shape_filter) is None:
            return [math.inf] * len(sensors)
        cos_theta, sin_theta = math.cos(theta_rad), math.sin(theta_rad)
        # A ray begins within the body, so that what touches the sensor, or overlaps it a little, is seen.
        length_m = max_range_m + _INSET_M
        found: list[float] = []
        for sensor in sensors:
            at_x_m = x_m + sensor.x_m * cos_theta - sensor.y_m * sin_theta
            at_y_m = y_m + sensor.x_m * sin_theta + sensor.y_m * cos_theta
            nearest_m = math.inf
            for ray in range(rays):
                spread = ray / (rays - 1) - 0.5 if rays > 1 else 0.0
                angle_rad = theta_rad + sensor.bearing_rad + spread * cone_rad
                cos_ray, sin_ray = math.cos(angle_rad), math.sin(angle_rad)
                start = (at_x_m - _INSET_M * cos_ray, at_y_m - _INSET_M * sin_ray)
                end = (at_x_m + max_range_m * cos_ray, at_y_m + max_range_m * sin_ray)
                hit = space.segment_query_first(start, end, 0.0, shape_filter)
                if hit is not None:
                    nearest_m = min(nearest_m, max(hit.alpha * length_m - _INSET_M, 0.0))
            found.append(nearest_m)
        return found

    def _pair(self, arbiter: pymunk.Arbiter) -> tuple[str, str]:
        first, second = sorted(self._names[shape] for shape in arbiter.shapes)
        return first, second

    def _begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        # Solid bodies that press against each other part and touch again and again: that is one contact.
        pair = self._pair(arbiter)
        last_s = self._touching.get(pair, -math.inf)
        self._touching[pair] = self._time_s
        if self._time_s - last_s < _TOUCH_AGAIN_S:
            return
        disc = next(self._discs[name] for name in pair if name in self._discs)
        x_m, y_m = disc.position
        self._contacts.append(Contact(self._time_s, pair, x_m, y_m))

    def _separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        self._touching[self._pair(arbiter)] = self._time_s
