"""Counting revolutions by the angle that is swept."""

from __future__ import annotations

import math

import pytest

from pancakes_encirclement.laps import Laps, on_circle


def go_round(laps: Laps, revolutions: float, steps: int = 100) -> int:
    """Goes round clockwise from the right; returns how often a revolution was completed."""
    angles = (-2 * math.pi * revolutions * step / steps for step in range(steps + 1))
    return sum(laps.passed((math.cos(a), math.sin(a)), (0.0, 0.0)) for a in angles)


def test_clockwise_counts_and_each_whole_revolution_is_told_once() -> None:
    laps = Laps()
    assert go_round(laps, 2.5) == 2
    assert laps.revolutions == pytest.approx(2.5)


def test_the_other_way_is_taken_off_again() -> None:
    laps = Laps()
    go_round(laps, 0.75)
    laps.recentred()
    go_round(laps, -0.25)
    assert laps.revolutions == pytest.approx(0.5)


def test_a_robot_that_stands_at_the_end_of_a_revolution_completes_it_once() -> None:
    laps = Laps()
    go_round(laps, 1.99)
    laps.recentred()
    assert [go_round(laps, part, 4) for part in (0.02, -0.02, 0.02, -0.02)] == [1, 0, 0, 0]
    assert laps.revolutions == 2.0, "a robot that takes the task over begins with what was told"
    go_round(laps, 0.5)
    assert laps.revolutions == pytest.approx(2.49), "and the noise adds nothing"


def test_a_first_step_the_other_way_completes_nothing() -> None:
    laps = Laps()
    assert [go_round(laps, part, 4) for part in (-0.01, 0.02)] == [0, 0]
    assert laps.revolutions == pytest.approx(0.02)


def test_the_count_goes_on_from_what_another_robot_has_counted() -> None:
    laps = Laps(3.9)
    assert go_round(laps, 0.2) == 1
    assert laps.revolutions == pytest.approx(4.1)


def test_a_new_centre_adds_no_angle_by_itself() -> None:
    laps = Laps()
    laps.passed((1.0, 0.0), (0.0, 0.0))
    laps.recentred()
    laps.passed((1.0, 0.0), (1.0, 1.0))
    assert laps.revolutions == 0.0


def test_a_tenth_of_the_radius_is_on_the_circle() -> None:
    assert on_circle((0.6, 0.0), (0.0, 0.0), 0.55)
    assert not on_circle((0.61, 0.0), (0.0, 0.0), 0.55)
