"""When a task's own rule asks for a move."""

from __future__ import annotations

import pytest

from pancakes.devices import Battery, Reserve
from pancakes.migration import MigrationRule


@pytest.mark.parametrize(
    ("bounds", "level", "asks"),
    [
        ({"below": 0.2}, 0.19, True),
        ({"below": 0.2}, 0.2, False),
        ({"below": 0.2}, 0.9, False),
        ({"above": 0.8}, 0.81, True),
        ({"above": 0.8}, 0.8, False),
        ({"above": 0.8}, 0.1, False),
        ({"below": 0.2, "above": 0.8}, 0.5, False),
        ({"below": 0.2, "above": 0.8}, 0.1, True),
        ({"below": 0.2, "above": 0.8}, 0.9, True),
        ({}, 0.5, False),
    ],
)
def test_a_reading_asks_for_a_move_beyond_a_bound_and_not_at_it(
    bounds: dict[str, float], level: float, asks: bool
) -> None:
    rule = MigrationRule("battery", bounds.get("below"), bounds.get("above"))
    assert rule.met_by({"level": level}) is asks


@pytest.mark.parametrize("reading", [{}, {"level": "low"}, {"level": None}, {"charge": 0.1}, None, 0.1])
def test_a_reading_without_a_number_in_the_field_asks_for_none(reading: object) -> None:
    assert not MigrationRule("battery", below=0.2).met_by(reading)


def test_the_field_may_be_another() -> None:
    assert MigrationRule("battery", below=0.2, field="charge").met_by({"level": 0.9, "charge": 0.1})
    assert MigrationRule("battery", below=0.2).met_by(Battery(7.4, 0.1))


def test_a_rule_on_the_reserve_reads_its_seconds_unless_it_names_another_field() -> None:
    rule = MigrationRule("reserve", below=30.0)
    assert (rule.field, rule.least_reserve_s, rule.least_level) == ("seconds", 30.0, None)
    assert rule.met_by(Reserve(29.0, 0.5)) and not rule.met_by(Reserve(30.0, 0.0))
    by_level = MigrationRule("reserve", below=0.1, field="level")
    assert by_level.least_reserve_s == 0.0 and by_level.met_by(Reserve(500.0, 0.05))


def test_only_a_rule_on_the_level_says_how_full_a_battery_must_be() -> None:
    assert MigrationRule("battery", below=0.2).least_level == 0.2
    assert MigrationRule("battery", below=7.0, field="voltage_v").least_level is None
