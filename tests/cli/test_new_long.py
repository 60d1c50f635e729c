"""What `pancakes new` has written runs as its README says."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.made_packages import made
from cli.processes import Rig

from pancakes.tools.cli.verbs.scaffold import KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_created_agent_runs(kind: str, tmp_path: Path, rig: Rig):
    folder = made(kind, tmp_path, rig)
    configs = sorted((folder / "configs").glob("*.toml"))
    assert len(configs) == (2 if kind == "plugin" else 1)
    for config in configs:
        checked = rig.agent(config, "--check")
        assert (checked.ended(), checked.everything()) == (0, "")

    config = folder / "configs" / ("sensor.toml" if kind == "plugin" else "green_house.toml")
    running = rig.agent(config, "--set", "agent.peers=[]")
    assert " info " in running.hear("/kernel: ready")
    rig.entry(running.pid)  # it goes on to run
    running.process.terminate()
    assert running.ended() == 0
    # On a busy machine a thread may be held by others than us.
    loud = [line for line in running.said if " error " in line or " warning " in line]
    assert [line for line in loud if "has held a thread" not in line] == []
