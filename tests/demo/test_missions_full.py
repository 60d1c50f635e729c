"""Each demo in virtual time with faults of the network, for the seeds beyond those of each day."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from demo.flight_checks import check_encirclement, check_intruder, check_pioneer, check_rescue


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("check", "seeds"),
    [
        (check_encirclement, range(3, 12)),
        (check_encirclement, range(12, 21)),
        (check_pioneer, (2,)),
        (check_intruder, (2,)),
        (check_rescue, range(2, 6)),
    ],
)
def test_missions_of_many_seeds_pass(check: Callable[[int, Path], Any], seeds: range, tmp_path: Path) -> None:
    failed: dict[int, str] = {}
    for seed in seeds:
        try:
            check(seed, tmp_path / str(seed))
        except AssertionError as error:
            failed[seed] = str(error)
    assert failed == {}
