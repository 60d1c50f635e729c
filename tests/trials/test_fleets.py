"""Fleets as processes and in virtual time, for as long as a test may take; `scripts/soak` runs them for long."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.agent_process import PYTHON_PATH
from soak import steady, virtual
from soak.agents import Fleet, NotInTime, names_of
from soak.vitals import vitals_of

pytestmark = pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="reads what Linux says")


def silent(text: str) -> None:
    pass


def test_twelve_processes_that_are_started_at_once_meet_and_lose_nobody(tmp_path):
    outcome = steady.run(tmp_path, 12, 5.0, silent)
    assert outcome.faults == []
    assert outcome.processor_ms > 0 and outcome.sent_bytes > 0 and outcome.memory_kib > 1000


def test_an_agent_that_was_killed_is_missed_by_all_and_meets_all_again(tmp_path):
    with Fleet(tmp_path, names_of(5), {}) as fleet:
        fleet.start()
        fleet.until(fleet.is_full_mesh, "all meet")
        fleet.agents["a003"].end(kill=True)
        missed = {(agent, "a003") for agent in names_of(5) if agent != "a003"}
        fleet.until(lambda: missed <= {(agent, peer) for agent, peer, _ in fleet.ended_links()}, "all miss it")
        fleet.start("a003")
        fleet.until(lambda: fleet.all_ready() and fleet.is_full_mesh(), "all meet again")


def test_who_ends_by_itself_is_told(tmp_path):
    with Fleet(tmp_path, names_of(2), {"a001": "[task.None]\ntype = 7\n"}) as fleet:
        fleet.start()
        with pytest.raises(NotInTime, match="a001 ended by itself"):
            fleet.until(fleet.is_full_mesh, "all meet")


def test_sixty_agents_meet_give_each_task_to_the_next_and_lose_nobody_in_virtual_time():
    outcome = virtual.run(60, 20.0, 1, silent)
    assert outcome.faults == []
    assert (outcome.moved, outcome.links) == (60, 60 * 59)
    assert outcome.met_s < 1.0


def test_what_a_process_holds_open_is_counted():
    reader, writer = os.pipe()
    try:
        here = vitals_of(os.getpid())
        with Path("/proc/self/stat").open():
            more = vitals_of(os.getpid())
        assert (more.files, more.sockets) == (here.files + 1, here.sockets)
        assert more.threads >= 1 and more.rss_kib >= more.pss_kib > 1000
    finally:
        os.close(reader)
        os.close(writer)


def test_a_short_soak_finds_what_leaks_and_nothing_else_and_writes_what_it_saw(tmp_path):
    figures = tmp_path / "figures.json"
    command = [sys.executable, "-m", "soak", "--minutes", "0.4", "--agents", "3", "--leak", "2000000"]
    found = subprocess.run(
        [*command, "--json", str(figures)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    written = json.loads(figures.read_text())
    assert sum("more pieces of memory are in use at rest" in fault for fault in written["faults"]) == 2, found.stdout
    # In half a minute resident memory still grows, and samples are few: everything else must be well.
    assert [fault for fault in written["faults"] if "memory" not in fault] == [], found.stdout
    assert found.returncode == 1
    assert written["counts"]["move"] > 0 and written["counts"]["killed"] > 0
    assert set(written["calm"]) == set(names_of(3)) and all(len(it) == 2 for it in written["calm"].values())
