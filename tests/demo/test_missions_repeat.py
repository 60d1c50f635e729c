"""A mission in virtual time repeats itself to the byte; and the command leaves behind all that it promises."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from demo.flights import Flight, read_flight

RESULTS = ("events.jsonl", "trajectory.csv", "summary.json")
TASKS = {"", "ScanTarget", "GoHome"}


def begin(out: Path, seed: int, hash_seed: int) -> subprocess.Popen[str]:
    """Starts a mission as a person would, in a process of its own."""
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "demo", "encirclement", "--virtual", "--faults"]
    return subprocess.Popen(
        [*command, "--seed", str(seed), "--out", str(out)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three missions: one, the same once more with other hashes, and one with another seed."""
    root = tmp_path_factory.mktemp("repeat")
    begun = {
        "one": begin(root / "one", seed=4, hash_seed=1),
        "again": begin(root / "elsewhere" / "again", seed=4, hash_seed=2),
        "other": begin(root / "other", seed=5, hash_seed=1),
    }
    try:
        for process in begun.values():
            # On a quiet machine it takes five seconds.
            said, _ = process.communicate(timeout=600)
            assert process.returncode == 0, said
            assert "verdict: PASS" in said
    finally:
        for process in begun.values():
            process.kill()
            process.communicate()
    return {"one": root / "one", "again": root / "elsewhere" / "again", "other": root / "other"}


def test_the_same_seed_gives_the_same_bytes_and_another_gives_others(runs: dict[str, Path]) -> None:
    for name in RESULTS:
        one, again, other = ((runs[run] / name).read_bytes() for run in ("one", "again", "other"))
        assert len(one) > 500
        assert one == again, f"{name} differs between two runs of one seed"
        assert one != other, f"{name} does not depend on the seed"
    the_command_leaves_all_results(read_flight(runs["one"]))


def the_command_leaves_all_results(flight: Flight) -> None:
    """The files of a mission, and what stands in them."""
    assert {path.name for path in flight.out.iterdir()} == {*RESULTS, "timing.json", "paths.png"}
    assert (flight.out / "paths.png").read_bytes().startswith(b"\x89PNG")
    assert {
        "verdict",
        "reasons",
        "seed",
        "duration_s",
        "circle",
        "homes",
        "holders",
        "gap_s",
        "overlap_s",
        "bids",
        "refusals",
        "state_moved",
        "radius_error_m",
        "home_error_m",
        "collisions",
        "out_of_bounds",
    } <= flight.summary.keys()
    assert flight.summary["seed"] == 4 and flight.summary["duration_s"] == 300.0
    assert flight.summary["circle"].keys() == {"x_m", "y_m", "radius_m"}
    assert flight.summary["homes"].keys() == {"agent1", "agent2"}
    assert all(holder.keys() == {"agent", "start_s", "end_s"} for holder in flight.summary["holders"])
    assert all(bid.keys() == {"agent", "cost"} for bid in flight.summary["bids"])
    assert all(refusal.keys() == {"agent", "reason"} for refusal in flight.summary["refusals"])
    assert all(error.keys() == {"mean", "max"} for error in flight.summary["radius_error_m"].values())
    # What belongs to the wall's clock stands apart, so that the rest can repeat itself.
    assert {"mode", "wall_s", "times_real_time"} <= flight.timing.keys()
    assert not re.search("wall|real_time", (flight.out / "summary.json").read_text(encoding="utf-8"))
    the_trajectory_is_the_whole_truth(flight)


def the_trajectory_is_the_whole_truth(flight: Flight) -> None:
    """A row for each robot, the sensor and the mover, ten times a second from the start to the end."""
    assert list(flight.paths) == ["agent1", "agent2", "sensor", "mover"]
    times = [moment.t_s for moment in flight.paths["agent1"]]
    assert times[0] == 0.0 and times[-1] == pytest.approx(300.0, abs=0.2)
    assert len(times) >= 10 * (300 - 1)
    for path in flight.paths.values():
        assert [moment.t_s for moment in path] == times
    assert {moment.driven_by for path in flight.paths.values() for moment in path} == TASKS
    first, second = flight.paths["agent1"], flight.paths["agent2"]
    assert first[0].driven_by == "" and second[0].driven_by == "", "nobody drives before the first command"
    assert second[-1].driven_by == "ScanTarget" and first[-1].driven_by == "GoHome"
