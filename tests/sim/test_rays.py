"""Rays in closed form find what pymunk's find."""

import math
import random

import pymunk
import pytest

from pancakes.sim.arena import Arena
from pancakes.sim.rays import Fan
from pancakes.sim.robot_models import KHEPERA_III, IrRing, SonarRing

HALF_M = (2.0, 1.5)
INSET_M = 0.05


def pymunk_ranges(disc, others, ring, rays, max_range_m):
    """The same readings, by pymunk: a ray each, which begins within the body."""
    space = pymunk.Space()
    x_m, y_m = HALF_M
    for start, end in (((-x_m, -y_m), (x_m, -y_m)), ((x_m, -y_m), (x_m, y_m)), ((x_m, y_m), (-x_m, y_m))):
        space.add(pymunk.Segment(space.static_body, start, end, 0.0))
    space.add(pymunk.Segment(space.static_body, (-x_m, y_m), (-x_m, -y_m), 0.0))
    for other in others:
        space.add(pymunk.Circle(space.static_body, other.radius_m, other.position))
    found = []
    cos, sin = math.cos(disc.theta_rad), math.sin(disc.theta_rad)
    for sensor in ring.sensors:
        at_x_m, at_y_m = disc.x_m + sensor.x_m * cos - sensor.y_m * sin, disc.y_m + sensor.x_m * sin + sensor.y_m * cos
        nearest_m = math.inf
        for ray in range(rays):
            angle_rad = disc.theta_rad + sensor.bearing_rad + (ray / (rays - 1) - 0.5) * ring.cone_rad
            way = (math.cos(angle_rad), math.sin(angle_rad))
            start = (at_x_m - INSET_M * way[0], at_y_m - INSET_M * way[1])
            end = (at_x_m + max_range_m * way[0], at_y_m + max_range_m * way[1])
            hit = space.segment_query_first(start, end, 0.0, pymunk.ShapeFilter())
            if hit is not None:
                nearest_m = min(nearest_m, max(hit.alpha * (max_range_m + INSET_M) - INSET_M, 0.0))
        found.append(nearest_m)
    return found


def check_ring(kind, seed):
    """Check a ring of sensors of each of thirty robots, which stand where the seed puts them."""
    source = random.Random(seed)
    arena = Arena(2 * HALF_M[0], 2 * HALF_M[1])
    places: list[tuple[float, float]] = []
    while len(places) < 30:
        x_m, y_m = source.uniform(-1.9, 1.9), source.uniform(-1.4, 1.4)
        if all(math.hypot(x_m - other_x, y_m - other_y) > 0.14 for other_x, other_y in places):
            places.append((x_m, y_m))
    discs = [
        arena.add(f"robot{number}", x_m, y_m, source.uniform(-4.0, 4.0), 0.065, 0.69)
        for number, (x_m, y_m) in enumerate(places)
    ]
    ring: IrRing | SonarRing | None
    ring, rays = (KHEPERA_III.ir, 3) if kind == "ir" else (KHEPERA_III.sonar, 5)
    assert ring is not None
    max_range_m = ring.curve.farthest_m if isinstance(ring, IrRing) else ring.max_range_m
    fan = Fan(ring.sensors, ring.cone_rad, rays, max_range_m)
    for disc in discs:
        others = [other for other in discs if other is not disc]
        wanted = pymunk_ranges(disc, others, ring, rays, max_range_m)
        assert arena.ranges(disc, fan) == pytest.approx(wanted, abs=1e-9), seed


@pytest.mark.parametrize("kind", ["ir", "sonar"])
def test_rays_of_a_ring_see_what_pymunk_sees(kind):
    for seed in range(10):
        check_ring(kind, seed)
