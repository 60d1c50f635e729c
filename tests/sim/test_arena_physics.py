"""Solid bodies in the arena: rays that hit them at known distances, contacts that are told once."""

import math

import pytest

from pancakes.sim.arena import Arena
from pancakes.sim.rays import Fan
from pancakes.sim.robot_models import RangeSensor

DT_S = 0.01
AHEAD = RangeSensor(0.05, 0.0, 0.0)


def run(arena, duration_s, start_s=0.0):
    for step in range(round(duration_s / DT_S)):
        arena.step(start_s + (step + 1) * DT_S, DT_S)


@pytest.fixture
def arena():
    return Arena(4.0, 2.0)


@pytest.mark.parametrize(
    ("theta_rad", "wall_m"), [(0.0, 1.95), (math.pi / 2, 0.95), (math.pi, 1.95), (-math.pi / 2, 0.95)]
)
def test_a_ray_meets_each_wall_where_it_stands(arena, theta_rad, wall_m):
    disc = arena.add("robot", 0.0, 0.0, theta_rad, 0.05, 1.0)
    assert arena.ranges(disc, Fan([AHEAD], 0.0, 1, 4.0)) == pytest.approx([wall_m], abs=1e-6)


def test_a_ray_meets_another_body_at_its_edge_and_not_its_own(arena):
    disc = arena.add("robot", -1.0, 0.0, 0.0, 0.065, 1.0)
    arena.add("sensor", 0.0, 0.0, 0.0, 0.06)
    sensor = RangeSensor(0.065, 0.0, 0.0)
    assert arena.ranges(disc, Fan([sensor], 0.0, 1, 4.0)) == pytest.approx([1.0 - 0.065 - 0.06], abs=1e-6)


def test_beyond_its_range_a_ray_meets_nothing(arena):
    disc = arena.add("robot", 0.0, 0.0, 0.0, 0.05, 1.0)
    assert arena.ranges(disc, Fan([AHEAD], 0.0, 1, 0.2)) == [math.inf]
    assert arena.ranges(disc, Fan([AHEAD], 0.0, 1, 1.94)) == [math.inf]
    assert arena.ranges(disc, Fan([AHEAD], 0.0, 1, 1.96)) == pytest.approx([1.95], abs=1e-6)


def test_a_cone_says_what_is_nearest_in_it(arena):
    disc = arena.add("robot", -1.0, 0.0, 0.0, 0.05, 1.0)
    angle_rad = math.radians(10)  # on the edge of a cone of 20 degrees
    arena.add("post", -1.0 + math.cos(angle_rad), math.sin(angle_rad), 0.0, 0.05)
    (wide,) = arena.ranges(disc, Fan([AHEAD], math.radians(20), 3, 4.0))
    (narrow,) = arena.ranges(disc, Fan([AHEAD], math.radians(2), 3, 4.0))
    assert wide == pytest.approx(0.9, abs=0.02)
    assert narrow == pytest.approx(2.95, abs=0.01)


def test_what_touches_a_sensor_is_at_distance_0(arena):
    disc = arena.add("robot", 0.0, 0.0, 0.0, 0.05, 1.0)
    arena.add("post", 0.1, 0.0, 0.0, 0.05)
    assert arena.ranges(disc, Fan([AHEAD], 0.0, 1, 0.2)) == pytest.approx([0.0], abs=1e-9)


def test_a_rolling_body_drives_an_arc(arena):
    radius_m, v_mps = 0.5, 0.1
    disc = arena.add("robot", radius_m, 0.0, math.pi / 2, 0.05, 1.0)
    disc.roll(v_mps, v_mps / radius_m)
    for quarter in range(4):
        run(arena, math.pi / 2 * radius_m / v_mps / 1.0, quarter * 10.0)
        assert math.hypot(*disc.position) == pytest.approx(radius_m, abs=0.001)
    assert disc.course()[1] == pytest.approx(v_mps, abs=1e-6)
    assert disc.course()[2] == pytest.approx(0.2)


def test_headings_stay_within_a_half_turn(arena):
    disc = arena.add("robot", 0.0, 0.0, 0.0, 0.05, 1.0)
    disc.roll(0.0, 1.0)
    for second in range(10):
        run(arena, 1.0, second)
        assert -math.pi < disc.theta_rad <= math.pi


def test_a_wall_stops_a_body_and_is_told_once(arena):
    disc = arena.add("robot", 1.5, 0.0, 0.0, 0.1, 1.0)
    disc.roll(0.2, 0.0)
    run(arena, 5.0)
    x_m, _ = disc.position
    assert x_m == pytest.approx(1.9, abs=0.003)
    (contact,) = arena.take_collisions()
    assert contact.names == ("robot", "wall")
    assert contact.time_s == pytest.approx(2.0, abs=0.05)
    assert contact.x_m == pytest.approx(1.9, abs=0.01)
    assert arena.take_collisions() == []


def test_what_stands_for_good_is_solid(arena):
    disc = arena.add("robot", -1.0, 0.0, 0.0, 0.1, 1.0)
    arena.add("sensor", 0.0, 0.0, 0.0, 0.06)
    disc.roll(0.3, 0.0)
    run(arena, 6.0)
    assert math.dist(disc.position, (0.0, 0.0)) >= 0.155
    assert [contact.names for contact in arena.take_collisions()] == [("robot", "sensor")]


def test_a_second_collision_later_is_told_again(arena):
    disc = arena.add("robot", 1.7, 0.0, 0.0, 0.1, 1.0)
    disc.roll(0.2, 0.0)
    run(arena, 2.0)
    disc.roll(-0.2, 0.0)
    run(arena, 2.0, 2.0)
    disc.roll(0.2, 0.0)
    run(arena, 4.0, 4.0)
    assert len(arena.take_collisions()) == 2


def test_a_walker_looks_where_it_goes(arena):
    disc = arena.add("mover", 0.0, 0.0, 0.0, 0.1, 70.0)
    disc.walk(0.0, -0.2)
    run(arena, 1.0)
    assert disc.theta_rad == pytest.approx(-math.pi / 2)
    assert disc.course()[1] == pytest.approx(0.2)
    disc.walk(0.0, 0.0)
    run(arena, 0.1, 1.0)
    assert disc.theta_rad == pytest.approx(-math.pi / 2)


def test_inside_is_where_the_centre_is(arena):
    assert arena.inside(arena.add("in", 1.99, 0.0, 0.0, 0.1, 1.0))
    assert not arena.inside(arena.add("out", 2.01, 0.0, 0.0, 0.1, 1.0))
