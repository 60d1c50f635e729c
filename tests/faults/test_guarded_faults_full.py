"""Fifty faults of real agents that guard a task, of all kinds; `scripts/torture takeovers` makes a thousand."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.guarded_faults import Takeovers
from torture.strokes import KINDS


@pytest.mark.timeout(900)
def test_guarded_faults_never_have_two_act_or_none(tmp_path: Path) -> None:
    tally = Takeovers(tmp_path).run(faults=50, fleets=4)
    print("\n".join(tally.told()))
    assert tally.failures(KINDS) == []
    assert tally.faults.total() == 50 and tally.meanwhile >= 15
