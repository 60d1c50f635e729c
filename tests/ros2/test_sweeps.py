"""A ring whose sensors speak for themselves: one that measures nothing, or says nothing, costs no sweep."""

import pytest
from pancakes_ros2.sweeps import Sweeps

FAR = (2.0, 4.0)


def sweeps_of(rounds, count=8):
    """What comes of sensors that speak in turns; `rounds` has, for each turn, what each of them measures."""
    sweeps = Sweeps(count)
    found = [sweeps.heard(number, measured) for one in rounds for number, measured in one.items()]
    return [sweep for sweep in found if sweep is not None], sweeps


def test_one_of_eight_that_measures_nothing_is_left_out_of_every_sweep():
    found, sweeps = sweeps_of([{number: None if number == 3 else FAR for number in range(8)}] * 50)
    assert len(found) == 50
    assert all(sorted(sweep) == [0, 1, 2, 4, 5, 6, 7] for sweep in found)
    assert not sweeps.silent


def test_one_of_eight_that_says_nothing_is_not_waited_for():
    found, sweeps = sweeps_of([{number: FAR for number in range(8) if number != 3}] * 50)
    assert len(found) >= 48
    assert all(sorted(sweep) == [0, 1, 2, 4, 5, 6, 7] for sweep in found)
    assert sweeps.silent == {3}


def test_one_that_speaks_again_is_waited_for_again():
    rounds = [{0: FAR}] * 10 + [{0: FAR, 1: FAR}] * 10
    found, sweeps = sweeps_of(rounds, 2)
    assert not sweeps.silent
    assert [sorted(sweep) for sweep in found[-5:]] == [[0, 1]] * 5


def test_sensors_whose_turns_are_not_quite_even_are_all_in_each_sweep():
    rounds = [{0: FAR}, {0: FAR, 1: FAR}, {1: FAR}, {0: FAR, 1: FAR}, {0: FAR}, {1: FAR}] * 10
    found, _ = sweeps_of(rounds, 2)
    assert all(sorted(sweep) == [0, 1] for sweep in found)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_a_ring_of_which_none_measures_anything_has_empty_sweeps(count):
    found, _ = sweeps_of([dict.fromkeys(range(count))] * 5, count)
    assert found == [{}] * 5
