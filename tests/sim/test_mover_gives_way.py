"""A mover walks through the arena, and never runs into a robot, though no robot looks where it goes."""

import math
import random

import pytest

from pancakes.sim.pedestrian import DECIDE_EVERY_S, MoverSettings, Obstacle, Wayfinder

ROBOT_RADIUS_M = 0.065
HALF_WIDTH_M, HALF_HEIGHT_M = 2.5, 2.0


def walk(settings, seed, robots_at, duration_s, sensor_radius_m=0.06):
    """Yield (time, x, y, robots) of a mover among robots that are blind.

    `robots_at` returns (x, y, vx, vy) of each robot at a time.
    """
    mover = Wayfinder(settings, HALF_WIDTH_M, HALF_HEIGHT_M, random.Random(seed))
    x_m, y_m = settings.x_m, settings.y_m
    keep_m = max(settings.keep_out_m, settings.radius_m + sensor_radius_m)
    sensor = Obstacle(0.0, 0.0, 0.0, 0.0, keep_m)
    for step in range(round(duration_s / DECIDE_EVERY_S)):
        time_s = step * DECIDE_EVERY_S
        robots = robots_at(time_s)
        distance_m = settings.radius_m + ROBOT_RADIUS_M + settings.clearance_m
        obstacles = [Obstacle(x, y, vx, vy, distance_m) for x, y, vx, vy in robots]
        vx_mps, vy_mps = mover.decide(time_s, x_m, y_m, obstacles, [sensor])
        assert math.hypot(vx_mps, vy_mps) <= settings.max_speed_mps + 1e-9
        x_m += vx_mps * DECIDE_EVERY_S
        y_m += vy_mps * DECIDE_EVERY_S
        yield time_s, x_m, y_m, robots


def circling(time_s):
    phase = 0.1 * time_s / 0.55
    return [(0.55 * math.cos(phase), 0.55 * math.sin(phase), -0.1 * math.sin(phase), 0.1 * math.cos(phase))]


def commuting(time_s):
    """A robot that drives to and fro between its home and the circle, at 0.1 m/s, straight on."""
    leg_s, home, goal = 15.0, (1.5, -1.2), (0.39, -0.39)
    there = int(time_s / leg_s) % 2 == 0
    share = (time_s % leg_s) / leg_s
    (x0, y0), (x1, y1) = (home, goal) if there else (goal, home)
    return [(x0 + share * (x1 - x0), y0 + share * (y1 - y0), (x1 - x0) / leg_s, (y1 - y0) / leg_s)]


def gap_m(x_m, y_m, robots, settings):
    return min(math.hypot(r[0] - x_m, r[1] - y_m) for r in robots) - ROBOT_RADIUS_M - settings.radius_m


# The second mover is sent through the middle of the circle: keeping off the ring is not what saves it.
@pytest.mark.parametrize("settings", [MoverSettings(-1.5, 1.0), MoverSettings(-1.5, 1.0, keep_out_m=0.25)])
def test_mover_never_runs_into_a_robot_on_the_circle(settings):
    for seed in range(20):
        walked_m, last = 0.0, (settings.x_m, settings.y_m)
        for time_s, x_m, y_m, robots in walk(settings, seed, circling, 300.0):
            assert gap_m(x_m, y_m, robots, settings) > 0.1, f"seed {seed} at {time_s:.1f} s"
            walked_m += math.dist(last, (x_m, y_m))
            last = (x_m, y_m)
        assert walked_m > 20.0, f"seed {seed}: a mover that never moves is safe and of no use"


def test_mover_never_runs_into_robots_that_commute():
    settings = MoverSettings(-1.5, 1.0)
    for seed in range(10):
        for time_s, x_m, y_m, robots in walk(settings, seed, lambda t: circling(t) + commuting(t), 300.0):
            assert gap_m(x_m, y_m, robots, settings) > 0.05, f"seed {seed} at {time_s:.1f} s"


def test_mover_keeps_off_the_sensor_and_the_walls():
    settings = MoverSettings(-1.5, 1.0)
    for seed in range(5):
        for _, x_m, y_m, _ in walk(settings, seed, circling, 300.0):
            assert math.hypot(x_m, y_m) > settings.keep_out_m - 0.1
            assert abs(x_m) < HALF_WIDTH_M - settings.radius_m
            assert abs(y_m) < HALF_HEIGHT_M - settings.radius_m


def test_it_steps_aside_for_a_robot_that_comes_while_it_rests():
    settings = MoverSettings(0.0, 0.0, starts_s=1000.0)
    mover = Wayfinder(settings, HALF_WIDTH_M, HALF_HEIGHT_M, random.Random(1))
    coming = Obstacle(-0.6, 0.0, 0.1, 0.0, 0.565)
    far_away = Obstacle(-2.0, 0.0, 0.0, 0.0, 0.565)
    assert mover.decide(0.0, 0.0, 0.0, [far_away], []) == (0.0, 0.0)
    vx_mps, vy_mps = mover.decide(0.1, 0.0, 0.0, [coming], [])
    assert math.hypot(vx_mps, vy_mps) == pytest.approx(settings.max_speed_mps)
    assert vx_mps > 0.0


def test_it_walks_to_its_waypoints_in_turn_and_begins_when_it_is_told():
    settings = MoverSettings(0.0, 0.0, waypoints=((1.0, 0.0), (1.0, 1.0)), starts_s=5.0, max_pause_s=0.0)
    mover = Wayfinder(settings, HALF_WIDTH_M, HALF_HEIGHT_M, random.Random(1))
    x_m = y_m = 0.0
    reached: list[tuple[float, float]] = []
    for step in range(400):
        vx_mps, vy_mps = mover.decide(step * 0.1, x_m, y_m, [], [])
        if step < 50:
            assert (vx_mps, vy_mps) == (0.0, 0.0)
        x_m, y_m = x_m + vx_mps * 0.1, y_m + vy_mps * 0.1
        for waypoint in settings.waypoints:
            if math.dist(waypoint, (x_m, y_m)) < 0.06 and reached[-1:] != [waypoint]:
                reached.append(waypoint)
    assert reached[:3] == [(1.0, 0.0), (1.0, 1.0), (1.0, 0.0)]


def test_the_seed_draws_its_way():
    def end(seed):
        return list(walk(MoverSettings(-1.5, 1.0), seed, circling, 60.0))[-1][1:3]

    assert end(1) == end(1)
    assert end(1) != end(2)


def test_speeds_that_contradict_each_other_are_refused():
    with pytest.raises(ValueError, match="min_speed_mps = 0.5 exceeds max_speed_mps = 0.3"):
        MoverSettings(min_speed_mps=0.5)
