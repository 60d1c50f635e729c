"""`scripts/bench --quick`, by its real command, and a short run of the most expensive topics."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from benchmarks import big_world, many_tasks, many_topics, virtual_fleet


def test_bench_writes_the_figures_of_a_topic(program: Any, tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    ended = program("benchmarks", "--quick", "--only", "two_processes", "--json", path)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    figures = json.loads(path.read_text())
    assert len(figures) == 7
    for figure in figures:
        assert {"name", "unit", "wanted", "sense"} <= set(figure) and len(figure["runs"]) == 5
        assert figure["ratio"] == pytest.approx(figure["value"] / figure["baseline"]) and figure["value"] > 0


def test_bench_measures_worlds_and_many_tasks() -> None:
    """Every robot gets its readings, every task comes to run; larger worlds take more."""
    percent, readings_hz, p50_ms, p99_ms = big_world.world(5, 1.0)
    assert percent > 0.0 and readings_hz > 0.0 and 0.0 < p50_ms <= p99_ms
    assert 0.0 < big_world.simulation_alone(1, 0.2) < big_world.simulation_alone(100, 0.2)
    for way in (many_tasks.of_a_service, many_tasks.bare_actors):
        start_ms, memory_mib = way(20)
        assert start_ms > 0 and memory_mib >= 0
    # What two agents take differs by less for so few tasks than it does by chance.
    assert all(map(math.isfinite, many_tasks.configured(20)))


def test_bench_measures_fleets_and_many_topics() -> None:
    """An agent of a fleet in virtual time costs something, and hardly more in a larger one; topics arrive."""
    few, more = virtual_fleet.run(4, 20.0), virtual_fleet.run(12, 20.0)
    assert all(figure > 0 for figure in (few[0], *few[2:], more[0], *more[2:]))
    assert more[2] < 3 * few[2]
    cores, packet_us, came_percent = many_topics.run(1.0)
    assert cores > 0 and packet_us > 0 and 10.0 < came_percent < 120.0
