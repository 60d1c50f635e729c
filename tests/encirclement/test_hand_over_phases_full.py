"""A hand-over on the circle in hundreds of phases."""

from __future__ import annotations

import pytest
from encirclement.hand_over import KHEPERA, PIONEER, Stage, trouble_of


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("stage", "seeds"),
    [(KHEPERA, range(25, 100)), (KHEPERA, range(100, 200)), (PIONEER, range(25, 100))],
    ids=["kheperas", "more kheperas", "pioneers"],
)
def test_hand_over_in_many_phases_touches_nothing(stage: Stage, seeds: range) -> None:
    assert trouble_of(stage, seeds) == {}
