"""A member of the fleet sends an agent frames that are nearly right; `scripts/torture fuzz` sends ten million."""

from __future__ import annotations

from pathlib import Path

from cli.processes import Rig
from torture.fuzz import fuzz, unsound


def test_odd_frames_leave_an_agent_alive_and_small(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    try:
        found = fuzz(rig, 10_000, 25, seed=1)
    finally:
        rig.close()
    assert unsound(found) == []
    assert found.frames >= 10_000 and found.ended >= 25
