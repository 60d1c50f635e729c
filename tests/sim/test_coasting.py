"""Bodies that can touch nothing go on by themselves, exactly as pymunk would move them; the others pymunk moves."""

import math
import random

import pytest

from pancakes.sim.arena import Arena, Solver
from pancakes.sim.bodies import Disc

DT_S = 0.01


def solver(*discs):
    made = Solver(10.0, 10.0, lambda names, place: None, lambda names: None)
    for disc in discs:
        made.add(disc)
    return made


def motion(disc):
    return (disc.x_m, disc.y_m, disc.angle_rad, disc.vx_mps, disc.vy_mps, disc.turning_radps)


def a_way(disc, seed, go):
    """Give a disc a new command now and then, and lets it go on by some steps."""
    source = random.Random(seed)
    for _ in range(200):
        if source.random() < 0.5:
            disc.roll(source.uniform(-0.3, 0.3), source.choice((0.0, source.uniform(-2.0, 2.0))))
        elif source.random() < 0.3:
            disc.walk(source.uniform(-0.3, 0.3), source.uniform(-0.3, 0.3))
        go(source.randint(1, 10))


def test_a_disc_that_coasts_goes_where_pymunk_would_move_it():
    coasting, solved = (Disc("robot", 0.065, 0.5, -0.5, 1.0, 0.69) for _ in range(2))
    world = solver(solved)

    def solve(steps):
        for _ in range(steps):
            world.step(DT_S)
        world.unload()

    a_way(coasting, 7, lambda steps: coasting.coast(steps, DT_S))
    a_way(solved, 7, solve)
    assert math.dist(coasting.position, (0.5, -0.5)) > 0.1
    assert motion(coasting) == pytest.approx(motion(solved), abs=1e-12)


def test_a_robot_that_drives_from_afar_into_another_still_runs_into_it():
    arena = Arena(20.0, 2.0)
    far = arena.add("far", -9.0, 0.0, 0.0, 0.065, 0.69)
    still = arena.add("still", 5.0, 0.0, 0.0, 0.065, 0.69)
    far.roll(0.3, 0.0)
    for step in range(500):
        arena.step(step * 0.1 + DT_S, DT_S, 10)
    contact = arena.take_collisions()[0]
    assert contact.names == ("far", "still")
    assert contact.time_s == pytest.approx(13.87 / 0.3, abs=0.1)
    assert still.x_m > 5.0, "what stands in the way is pushed on"
    assert math.dist(far.position, still.position) == pytest.approx(0.13, abs=0.002)


def test_many_robots_in_a_crowd_stay_apart_and_within_the_walls():
    arena = Arena(4.0, 4.0)
    source = random.Random(1)
    discs = [arena.add(f"{n}", (n % 7) * 0.5 - 1.5, n // 7 * 0.5 - 1.5, n, 0.065, 0.69) for n in range(49)]
    for step in range(300):
        for disc in discs:
            disc.roll(0.3, source.uniform(-1.0, 1.0))
        arena.step(step * 0.1 + DT_S, DT_S, 10)
    assert len(arena.take_collisions()) > 20
    for number, disc in enumerate(discs):
        assert max(abs(disc.x_m), abs(disc.y_m)) < 2.0 - 0.06
        for other in discs[number + 1 :]:
            assert math.dist(disc.position, other.position) > 0.12


def test_steps_one_by_one_lead_where_ten_at_a_time_do():
    ends = []
    for at_a_time in (1, 10):
        arena = Arena(4.0, 4.0)
        disc = arena.add("robot", 0.0, 0.0, 0.3, 0.065, 0.69)
        arena.add("post", 1.0, 1.0, 0.0, 0.06)
        disc.roll(0.2, 0.4)
        for start in range(0, 1000, at_a_time):
            arena.step((start + 1) * DT_S, DT_S, at_a_time)
        ends.append(motion(disc))
    assert ends[0] == pytest.approx(ends[1], abs=1e-12)
