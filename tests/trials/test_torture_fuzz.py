"""A short form of `scripts/torture fuzz`."""

from __future__ import annotations

from pathlib import Path

from cli.processes import Rig
from torture.fuzz import fuzz, unsound


def test_an_agent_lives_through_frames_that_are_nearly_right(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    try:
        found = fuzz(rig, 20_000, 50, seed=1)
    finally:
        rig.close()
    assert unsound(found) == []
    assert found.frames >= 20_000 and found.ended >= 50
