"""The policy of thresholds: steps down at once, steps up with hysteresis, never to and fro."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as some

from pancakes.energy.policies import Step, Thresholds

STEPS = (Step(0.8, 0.5), Step(0.5, 0.2), Step(0.2, 0.0))
HYSTERESIS = 0.05


def efforts(levels, steps=STEPS, hysteresis=HYSTERESIS):
    policy = Thresholds(steps, hysteresis)
    return [policy.decide(level) for level in levels]


def test_each_level_has_its_effort():
    assert efforts([1.0, 0.8, 0.79, 0.5, 0.49, 0.19]) == [1.0, 1.0, 0.5, 0.5, 0.2, 0.0]


def test_a_battery_that_falls_fast_passes_several_at_once():
    assert efforts([1.0, 0.1]) == [1.0, 0.0]


def test_it_goes_up_again_only_above_the_hysteresis():
    assert efforts([0.49, 0.54, 0.551, 0.84, 0.851]) == [0.2, 0.2, 0.5, 0.5, 1.0]


def test_a_battery_that_was_charged_gives_everything_back():
    assert efforts([0.1, 1.0]) == [0.0, 1.0]


def test_a_restart_keeps_the_hysteresis():
    policy = Thresholds(STEPS, HYSTERESIS)
    policy.resume(0.2)
    assert policy.decide(0.52) == 0.2, "a new policy would have said 0.5"
    fresh = Thresholds(STEPS, HYSTERESIS)
    fresh.resume(1.0)
    assert fresh.decide(0.52) == 0.5


@given(
    base=some.floats(0.0, 0.95),
    wobble=some.lists(some.floats(0.0, 0.999), min_size=2, max_size=40),
    steps=some.lists(some.floats(0.01, 0.94), min_size=1, max_size=6, unique=True),
)
def test_it_never_oscillates_within_the_hysteresis(base, wobble, steps):
    """In a band narrower than the hysteresis, whatever the level does there, the effort can only fall."""
    below = sorted(steps, reverse=True)
    ladder = tuple(Step(level, 0.9 * (1 - (place + 1) / len(below))) for place, level in enumerate(below))
    said = efforts([base + HYSTERESIS * share for share in wobble], ladder)
    assert all(later <= earlier for earlier, later in pairwise(said))
    assert len(set(said)) <= len(ladder) + 1


@given(levels=some.lists(some.floats(0.0, 1.0), min_size=1, max_size=60))
def test_the_effort_is_what_the_level_and_the_last_effort_allow(levels):
    """Never more than the thresholds give, never less than they would with the hysteresis added."""
    for level, effort in zip(levels, efforts(levels), strict=True):
        most = min((step.effort for step in STEPS if level < step.below), default=1.0)
        least = min((step.effort for step in STEPS if level < step.below + HYSTERESIS), default=1.0)
        assert least <= effort <= most


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_the_ends_of_the_range_are_levels_like_others(level):
    assert efforts([level]) == [level]
