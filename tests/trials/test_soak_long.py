"""`scripts/soak` for as long as a test may take: it finds a leak, and reports nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from soak import steady, virtual
from soak.agents import Fleet, names_of

pytestmark = pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="reads what Linux says")


def silent(text: str) -> None:
    pass


def test_soak_finds_a_leak_and_nothing_else(program: Any, tmp_path: Path) -> None:
    """By the real command. Agents are killed and come back; tasks start, stop and migrate."""
    path = tmp_path / "figures.json"
    ended = program("soak", "--minutes", "0.4", "--agents", "3", "--leak", "2000000", "--json", path)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    written = json.loads(path.read_text())
    assert sum("more pieces of memory are in use at rest" in fault for fault in written["faults"]) == 2, ended.stdout
    # In half a minute resident memory still grows, and samples are few: everything else must be well.
    assert [fault for fault in written["faults"] if "memory" not in fault] == [], ended.stdout
    assert written["counts"]["move"] > 0 and written["counts"]["killed"] > 0
    assert set(written["calm"]) == set(names_of(3)) and all(len(it) == 2 for it in written["calm"].values())


def test_soak_of_twelve_processes_loses_nobody(tmp_path: Path) -> None:
    """They are started at once."""
    outcome = steady.run(tmp_path, 12, 5.0, silent)
    assert outcome.faults == []
    assert outcome.processor_ms > 0 and outcome.sent_bytes > 0 and outcome.memory_kib > 1000


def test_soak_agent_that_was_killed_meets_all_again(tmp_path: Path) -> None:
    with Fleet(tmp_path, names_of(5), {}) as fleet:
        fleet.start()
        fleet.until(fleet.is_full_mesh, "all meet")
        fleet.agents["a003"].end(kill=True)
        missed = {(agent, "a003") for agent in names_of(5) if agent != "a003"}
        fleet.until(lambda: missed <= {(agent, peer) for agent, peer, _ in fleet.ended_links()}, "all miss it")
        fleet.start("a003")
        fleet.until(lambda: fleet.all_ready() and fleet.is_full_mesh(), "all meet again")


def test_soak_of_forty_virtual_agents_loses_nobody() -> None:
    """They connect, and the task of each migrates to the next one."""
    outcome = virtual.run(40, 20.0, 1, silent)
    assert outcome.faults == []
    assert (outcome.moved, outcome.links) == (40, 40 * 39)
    assert outcome.met_s < 1.0
