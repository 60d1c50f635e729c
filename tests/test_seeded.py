"""A test over many seeds names every seed that fails."""

import pytest
from seeded import for_each


def test_for_each_names_all_failing_cases():
    def is_even(n):
        assert n % 2 == 0

    with pytest.raises(ExceptionGroup, match="2 of 4 cases fail: 1, 3") as caught:
        for_each(range(4), is_even)
    assert [error.__notes__ for error in caught.value.exceptions] == [["case 1"], ["case 3"]]


def test_for_each_passes_if_all_cases_pass():
    seen: list[str] = []
    for_each("ab", seen.append)
    assert seen == ["a", "b"]


def test_for_each_stops_at_an_outcome_of_pytest():
    """A time-out of pytest ends the test, and not only one case."""
    with pytest.raises(pytest.fail.Exception):
        for_each(range(2), lambda _: pytest.fail("time-out"))
