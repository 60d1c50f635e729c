"""How a task may be guarded."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from pancakes.migration import GuardRule


@pytest.mark.parametrize("copies", [3, 5])
@pytest.mark.parametrize(
    "times", [{"lease_s": 2.0}, {"lease_s": 600.0}, {"checkpoint_s": 0.05}, {"checkpoint_s": 3600}]
)
def test_it_is_guarded_by_three_or_five_with_leases_of_two_seconds_to_ten_minutes(copies: int, times: Any) -> None:
    assert msgspec.convert({"copies": copies, **times}, GuardRule).copies == copies


@pytest.mark.parametrize(
    "wrong",
    [
        {"copies": 1},
        {"copies": 4},
        {"copies": 7},
        {"copies": 3, "lease_s": 1.99},
        {"copies": 3, "lease_s": 600.01},
        {"copies": 3, "checkpoint_s": 0.049},
        {"copies": 3, "checkpoint_s": 3600.1},
        {"copies": 3, "takeover": "never"},
    ],
)
def test_no_other_rule_is_one(wrong: Any) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, GuardRule)


def test_what_is_left_open_is_five_seconds_a_checkpoint_each_second_and_no_question() -> None:
    rule = GuardRule(3)
    assert (rule.lease_s, rule.checkpoint_s, rule.guardians, rule.takeover) == (5.0, 1.0, (), "auto")
