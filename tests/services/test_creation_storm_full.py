"""Tasks are created, moved and removed in storms: more seeds."""

from __future__ import annotations

import pytest
from services.creation_storms import GUARD, creation_storms


@pytest.mark.parametrize("keys", [{}, GUARD], ids=["unguarded", "guarded"])
def test_creation_storm_runs_no_task_twice_or_after_removal_full(keys: dict[str, object]) -> None:
    creation_storms(range(8), keys)
