"""The benchmarks' own arithmetic, and one short run from end to end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TESTS))

from benchmarks import fan_out  # noqa: E402
from benchmarks.figure import Figure, Plan, in_turns  # noqa: E402
from benchmarks.steady import Steady  # noqa: E402

from pancakes.control import Configure, Describe  # noqa: E402
from pancakes.testing import FleetInTest  # noqa: E402


def test_a_figure_is_the_median_of_ours_beside_the_median_of_the_bare_one():
    figure = Figure("x", "ns", wanted=2.0, runs=[30.0, 10.0, 20.0], bare_runs=[10.0, 10.0, 5.0])
    assert (figure.value, figure.baseline, figure.ratio, figure.spread) == (20.0, 10.0, 2.0, (1.0, 4.0))
    assert not figure.is_missed
    assert Figure("x", "1/s", "min", 2.1, figure.runs, figure.bare_runs).is_missed


def test_the_sides_are_measured_in_turns_and_each_begins_as_often():
    order: list[str] = []

    def side(name: str) -> list[float]:
        order.append(name)
        return [float(len(order))]

    (figure,) = in_turns(Plan(rounds=3), [Figure("x", "s")], lambda: side("ours"), lambda: side("bare"))
    assert order == ["ours", "bare", "bare", "ours", "ours", "bare"]
    assert (figure.runs, figure.bare_runs) == ([1.0, 4.0, 5.0], [2.0, 3.0, 6.0])


def test_every_subscriber_gets_all_that_is_published():
    delivery_ns, last_us = fan_out.from_a_task(subscribers=3, packets=200)
    assert delivery_ns > 0 and last_us > 0


def test_a_control_task_tells_how_late_it_was_between_two_marks():
    with FleetInTest() as fleet:
        agent = fleet.start("a", tasks={"Steady": Steady})
        for window in (1, 2):
            assert agent.ask(Configure("Steady", {"window": window})).ok
            fleet.run_for(2.0)
        state = agent.ask(Describe("Steady", state=True)).result["state"]
        assert (state["window"], state["late_us"]) == (2, [0] * 80)


def test_a_short_run_writes_its_figures_as_json(tmp_path):
    path = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--only", "two_processes", "--json", str(path)]
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(TESTS)}, check=True, capture_output=True)
    figures = json.loads(path.read_text())
    assert len(figures) == 5
    for figure in figures:
        wanted = {"name", "value", "unit", "baseline", "ratio", "wanted", "sense", "runs"}
        assert wanted <= set(figure)
        assert len(figure["runs"]) == 5
        assert figure["ratio"] == pytest.approx(figure["value"] / figure["baseline"])
        assert figure["sense"] in ("max", "min")
