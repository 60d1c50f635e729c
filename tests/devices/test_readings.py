"""How a device fares: misses in a row, shares of misses, and silence, at whatever times."""

import math

import pytest

from pancakes.devices.health import MissRule, Readings


def test_whatever_time_a_reading_came_its_age_is_looked_at_a_few_times_only():
    """A difference of two times may be a rounding short of the bound: then the next look must still come later."""
    for tenth in range(1, 300):
        readings = Readings(MissRule(), "reading", 1.0, 0.0)
        readings.came(tenth * 0.1)
        now_s, told = tenth * 0.1, []
        for _ in range(4):
            left_s, _, lines = readings.look(now_s)
            told += lines
            now_s += left_s
        assert told == [("warning", "no reading has come for 1.0 s of mission time")]


def test_without_a_bound_nothing_is_silent():
    assert Readings(MissRule(), "reading", None, 0.0).look(1e9) == (math.inf, False, [])


@pytest.mark.parametrize("in_a_row", [1, 2, 5])
def test_a_sound_reading_between_begins_the_row_anew(in_a_row):
    readings = Readings(MissRule(in_a_row=in_a_row, within_mission_s=1e6), "reading", None, 0.0)
    time_s = 0.0
    for _ in range(3):
        for _ in range(in_a_row - 1):
            time_s += 0.1
            assert readings.missed("noise", time_s)[1] is False
        readings.came(time_s)
    fails = [readings.missed("noise", time_s)[1] for _ in range(in_a_row)]
    assert fails == [False] * (in_a_row - 1) + [True]


def test_one_miss_in_each_span_is_told_once_in_each():
    readings = Readings(MissRule(within_mission_s=10.0), "command", None, 0.0)
    told: list[tuple[str, str]] = []
    for step in range(400):
        told += readings.missed("noise", step * 0.1)[0] if step % 100 == 50 else readings.came(step * 0.1)
    assert [text for _, text in told] == [
        "a command is missed: noise",
        "1 of 100 commands (1 %) were missed in 10 s, the last one so: noise",
        "1 of 100 commands (1 %) were missed in 10 s, the last one so: noise",
    ]
