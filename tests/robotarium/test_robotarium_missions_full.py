"""The encirclement in the Robotarium with faults of the network, for seeds beyond those of each day."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo.flights import fly
from robotarium.test_robotarium_mission import check_hand_over, check_laboratory


@pytest.mark.timeout(900)
@pytest.mark.usefixtures("robotarium")
@pytest.mark.parametrize("seeds", [range(3, 13), range(13, 23)])
def test_missions_of_many_seeds_pass_by_both_judges(seeds: range, tmp_path: Path) -> None:
    failed: dict[int, str] = {}
    for seed in seeds:
        try:
            flight = fly("robotarium", seed, tmp_path / str(seed), faults=True)
            assert flight.summary["reasons"] == []
            check_laboratory(flight)
            check_hand_over(flight)
        except AssertionError as error:
            failed[seed] = str(error)
    assert failed == {}
