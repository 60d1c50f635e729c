"""The benchmarks' own arithmetic, and one short run from end to end."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from benchmarks import fan_out
from benchmarks.agent_process import PYTHON_PATH
from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.observers import Compared, Round, Span, quiet
from benchmarks.steady import Steady

from pancakes.control import Configure, Describe
from pancakes.task import Tick
from pancakes.testing import FleetInTest


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
        for window in (1, 2, 3):
            assert agent.ask(Configure("Steady", {"window": window})).ok
            fleet.run_for(2.0)
        state = agent.ask(Describe("Steady", state=True)).result["state"]
        assert (state["window"], state["late_us"].split()) == (3, ["0"] * 80)


def test_ticks_that_never_came_count_as_late_as_they_would_have_been():
    with FleetInTest() as fleet:
        steady = fleet.start("a", tasks={"Steady": Steady}).task("Steady")
        steady.late_s.clear()
        steady.tick(Tick(steady.now() - 0.01, missed=2))
        assert steady.late_s == [pytest.approx(late_s) for late_s in (0.01, 0.035, 0.06)]


def observed(ratio: float, late_us: int, others_ms: float, bare_ms: float = 100.0) -> Round:
    """A round in which the machine had slowed down by a half when the observer went over to the other fleet."""
    usual_us, seen_us = [90] * 198 + [100] * 2, [90] * 393 + [late_us] * 4 + [3 * late_us] * 3
    bare = Span(bare_ms, usual_us, others_ms), Span(1.5 * bare_ms, usual_us, others_ms)
    ours = Span(bare_ms * ratio, seen_us, 50.0), Span(1.5 * bare_ms * ratio, seen_us, others_ms)
    return Round(ours, bare)


def test_an_observed_fleet_is_compared_with_its_twin_in_the_rounds_that_were_left_alone():
    alone = [observed(1.05, 200, 50.0) for _ in range(9)]
    disturbed = [observed(2.0, 9000, 1e6, bare_ms=300.0) for _ in range(2)]
    processor, p99 = Compared("x", "ms"), Compared("y", "us", share=0.99)
    for figure in (processor, p99):
        for measured in (*alone, *disturbed):
            figure.take(measured)
    assert (processor.value, processor.baseline) == (pytest.approx(131.25), 125.0)
    assert processor.spread == (pytest.approx(1.05), pytest.approx(1.05))
    assert (p99.ratio, p99.spread) == (2.0, (2.0, 2.0))
    assert processor.runs[-1] / processor.bare_runs[-1] == pytest.approx(2.0), "what does not count is written down too"


def test_where_all_rounds_were_disturbed_the_quieter_half_counts():
    rounds = [observed(1.0, 100, 1e6 * number) for number in range(1, 6)]
    assert quiet(rounds) == rounds[:3]


def test_the_range_of_a_ratio_is_wide_where_the_rounds_differ():
    figure = Compared("x", "ms")
    for ratio in (0.8, 1.0, 1.2, 0.9, 1.1):
        figure.take(observed(ratio, 100, 50.0))
    low, high = figure.spread
    assert figure.ratio == pytest.approx(1.0)
    assert 0.85 < low < 0.95 and 1.05 < high < 1.15


def test_a_short_run_writes_its_figures_as_json(tmp_path):
    path = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--only", "two_processes", "--json", str(path)]
    paths = os.pathsep.join(PYTHON_PATH)
    ended = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    figures = json.loads(path.read_text())
    assert len(figures) == 5
    for figure in figures:
        wanted = {"name", "value", "unit", "baseline", "ratio", "wanted", "sense", "runs"}
        assert wanted <= set(figure)
        assert len(figure["runs"]) == 5
        assert figure["ratio"] == pytest.approx(figure["value"] / figure["baseline"])
        assert figure["sense"] in ("max", "min")
