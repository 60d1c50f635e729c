"""A battery's level: of what a device tells, and of a voltage. Beyond its range it is no reading."""

import math

import pytest

from pancakes.devices.validation import level_at, level_of
from pancakes.errors import PancakesError


@pytest.mark.parametrize(
    ("told", "full", "level"),
    [(0, 100, 0.0), (97, 100, 0.97), (100, 100, 1.0), (0.5, 1.0, 0.5), (1.0000001, 1.0, 1.0), (-0.0000001, 1.0, 0.0)],
)
def test_a_level_is_a_share_of_what_is_full(told, full, level):
    assert level_of(told, full) == pytest.approx(level)


@pytest.mark.parametrize(
    ("told", "full", "sentence"),
    [
        (120, 100, "a level of 120 is not between 0 and full = 100"),
        (-1, 100, "a level of -1 is not between 0 and full = 100"),
        (85, 1.0, "set full = 100 if it speaks in percent"),
        (math.nan, 1.0, "a level of nan"),
        (1.01, 1.0, "a level of 1.01"),
    ],
)
def test_a_level_beyond_its_range_is_none(told, full, sentence):
    with pytest.raises(PancakesError, match=sentence):
        level_of(told, full)


@pytest.mark.parametrize(("voltage_v", "level"), [(6.0, 0.0), (7.0, 0.5), (8.0, 1.0), (8.1, 1.0), (5.0, 0.0)])
def test_a_voltage_means_a_level(voltage_v, level):
    assert level_at(voltage_v, 6.0, 8.0) == pytest.approx(level)


@pytest.mark.parametrize(
    ("voltage_v", "sentence"),
    [(12.6, "correct full_v"), (0.0, "is the battery connected"), (math.nan, "is the battery connected")],
)
def test_a_voltage_that_this_battery_cannot_have_means_none(voltage_v, sentence):
    with pytest.raises(PancakesError, match=sentence):
        level_at(voltage_v, 6.0, 8.0)
