"""Each demo, whole, in virtual time with faults of the network, for one or two seeds; more in `test_missions_full`."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo.flight_checks import check_encirclement, check_intruder, check_pioneer, check_rescue
from demo.flights import Flight

pytestmark = pytest.mark.cpu_limit(60.0)  # a mission takes up to ten seconds of a processor
TASKS = {"", "ScanTarget", "GoHome"}


def test_encirclement_passes_with_faults(tmp_path: Path) -> None:
    one, two = (check_encirclement(seed, tmp_path / str(seed)) for seed in (1, 2))
    check_results(one)
    for name in ("events.jsonl", "trajectory.csv", "summary.json"):
        assert (one.out / name).read_bytes() != (two.out / name).read_bytes(), f"{name} does not depend on the seed"


def test_pioneer_passes_with_faults(tmp_path: Path) -> None:
    check_pioneer(1, tmp_path)


def test_intruder_passes_with_faults(tmp_path: Path) -> None:
    check_intruder(1, tmp_path)


def test_rescue_passes_with_faults(tmp_path: Path) -> None:
    check_rescue(1, tmp_path)


def check_results(flight: Flight) -> None:
    """Checks which fields the results of a whole mission have, and that the trajectory is complete."""
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
    assert flight.summary["seed"] == 1 and flight.summary["duration_s"] == 300.0
    assert flight.summary["circle"].keys() == {"x_m", "y_m", "radius_m"}
    assert flight.summary["homes"].keys() == {"agent1", "agent2"}
    assert all(holder.keys() == {"agent", "start_s", "end_s"} for holder in flight.summary["holders"])
    assert all(bid.keys() == {"agent", "cost"} for bid in flight.summary["bids"])
    assert all(refusal.keys() == {"agent", "reason"} for refusal in flight.summary["refusals"])
    assert all(error.keys() == {"mean", "max"} for error in flight.summary["radius_error_m"].values())
    check_trajectory(flight)


def check_trajectory(flight: Flight) -> None:
    """Checks for a row of each robot, the sensor and the mover, ten times a second from the start to the end."""
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
