"""Two hundred fault schedules of whole virtual agents."""

from __future__ import annotations

import pytest
from faults.test_fault_schedules import check, check_again
from seeded import for_each


@pytest.mark.timeout(900)
def test_fault_schedules_run_each_task_once() -> None:
    for_each([range(first, first + 10) for first in range(1, 201, 10)], check)


def test_fault_schedules_of_a_seed_are_the_same() -> None:
    for_each((7, 9, 3169), check_again)
