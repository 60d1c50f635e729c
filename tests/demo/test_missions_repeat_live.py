"""A mission in virtual time repeats itself byte for byte, and the command leaves all the files that it promises."""

from __future__ import annotations

import re
from pathlib import Path

from demo.flights import SCAN, read_flight
from demo.missions_in_processes import Started

RESULTS = ("events.jsonl", "trajectory.csv", "summary.json")
SHORT = ("--seed", "4", "--duration", "45", "--set", "world:task.World.settings.robots.agent1.battery.capacity_j=130")
"""Agent 1's battery falls below 65 % after some 25 s, so that the task migrates soon."""


def test_missions_of_one_seed_repeat_byte_for_byte(tmp_path: Path) -> None:
    """The same seed with another hash seed of Python gives the same files."""
    one, again = tmp_path / "one", tmp_path / "elsewhere" / "again"
    with Started("encirclement", one, 1, *SHORT) as first, Started("encirclement", again, 2, *SHORT) as second:
        said = [started.ends(1) for started in (first, second)]
    assert all("verdict: FAIL" in text for text in said), "so short a mission leaves no time to settle"
    for name in RESULTS:
        assert len((one / name).read_bytes()) > 500
        assert (one / name).read_bytes() == (again / name).read_bytes(), f"{name} differs between two runs of one seed"
    flight = read_flight(one)
    assert [holder["agent"] for holder in flight.summary["holders"]] == ["agent1", "agent2"], "nothing migrated"
    assert flight.driven("agent2", SCAN)

    assert {path.name for path in one.iterdir()} == {*RESULTS, "timing.json", "paths.png"}
    assert (one / "paths.png").read_bytes().startswith(b"\x89PNG")
    # What depends on the wall clock is kept apart, so that the rest can repeat.
    assert {"mode", "wall_s", "times_real_time"} <= flight.timing.keys()
    assert not re.search("wall|real_time", (one / "summary.json").read_text(encoding="utf-8"))
