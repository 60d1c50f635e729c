"""`scripts/torture` runs missions and tells how they went; what it finds must show in its exit code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from benchmarks.agent_process import PYTHON_PATH
from click.testing import CliRunner
from torture import __main__ as command
from torture import gate_command, live_commands, standstill_command
from torture.gap import Gaps
from torture.late_acts import LateTally
from torture.missions import Job, Outcome, fly
from torture.points import Point
from torture.schedules import Outcome as ScheduleOutcome
from torture.tally import Tally


def test_missions_that_pass_give_exit_code_0() -> None:
    """Run as the script does it: its workers must find what they are to do."""
    ended = subprocess.run(
        [sys.executable, "-m", "torture", "missions", "--demo", "intruder", "--seeds", "2", "--jobs", "2"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "2 passed, 0 failed" in ended.stdout
    assert "radius error, mean: 0." in ended.stdout


def test_a_mission_that_fails_gives_exit_code_1_and_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def two(demo: str, seeds: range, faults: bool, batteries: bool, jobs: int) -> Iterator[Outcome]:
        for seed in seeds:
            summary: dict[str, Any] = {"verdict": "PASS", "reasons": [], "gap_s": 0.1 * seed}
            if seed == 8:
                summary |= {"verdict": "FAIL", "reasons": ["nobody drove for 0.80 s"]}
            yield Outcome(Job(demo, seed, Path(), faults, batteries), summary, 1.0)

    monkeypatch.setattr(command, "fly_all", two)
    result = CliRunner().invoke(command.torture, ["missions", "--seeds", "2", "--first", "7"])
    assert result.exit_code == 1
    assert "seed 8: FAIL: nobody drove for 0.80 s" in result.output
    assert "gap in control: 0.700 to 0.800 s" in result.output
    assert "1 passed, 1 failed" in result.output


def test_figures_are_written_for_programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def one(seeds: range, jobs: int) -> list[ScheduleOutcome]:
        return [ScheduleOutcome(seed, "One runs twice" if seed == 4 else "", Counter(kill=2), 0.5) for seed in seeds]

    monkeypatch.setattr(command, "run_schedules", one)
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["schedules", "--first", "3", "--seeds", "2", "--json", str(path)])
    assert result.exit_code == 1
    figures = json.loads(path.read_text())
    assert figures["violations"] == {"4": "One runs twice"} and figures["counts"]["kill"] == 4
    assert figures["healed_s"] == {"least": 0.5, "median": 0.5, "most": 0.5}


def test_kills_are_told_by_point_and_one_that_was_never_reached_fails(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def some(random_kills: int, points: list[Point], *others: Any) -> Tally:
        assert (random_kills, len(points)) == (3, 3)
        tally = Tally(kills=6, points=Counter({points[0].name: 2, points[1].name: 1}), heals_s=[1.0])
        tally.missed.append(f"no agent came to the point {points[2].name!r}")
        return tally

    monkeypatch.setattr(live_commands, "run_fleets", some)
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["kills", "--kills", "6", "--at", "both", "--json", str(path)])
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit), result.output
    assert "    2 killed: source: before it sends SOLICIT" in result.output
    assert "    0 killed: source: before it sends RESERVE" in result.output
    assert "agents killed: 6, 3 of them between effects, at 2 points" in result.output
    figures = json.loads(path.read_text())
    assert figures["kills"] == 6 and figures["points"]["source: before it sends SOLICIT"] == 2


def test_moves_that_come_to_nothing_fail_on_loopback_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def measured(size: int, moves: int, survey: Any) -> Gaps:
        return Gaps(size, [0.02, 0.03, 0.06], ["right: did not say that it has the snapshot"], [2.1])

    monkeypatch.setattr(live_commands, "measure", measured)
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["gap", "--no-netns", "--json", str(path)])
    assert result.exit_code == 1
    assert "loopback, 64 KiB of state: p50 30.0 ms, p99 60.0 ms, 3 moves: longer than 50 ms" in result.output
    assert "the task stood still for 2100 ms in these, at most" in result.output
    assert [row["state_bytes"] for row in json.loads(path.read_text())["gaps"]] == [1024, 65_536, 4 * 1024 * 1024]


def test_a_mission_that_breaks_down_fails(tmp_path: Path) -> None:
    outcome = fly(Job("no such demo", 1, tmp_path))
    assert outcome.summary["verdict"] == "FAIL"
    assert "unknown demo 'no such demo'" in outcome.summary["reasons"][0]


def test_an_unknown_demo_is_named() -> None:
    result = CliRunner().invoke(command.torture, ["missions", "--demo", "encirclment"])
    assert result.exit_code == 2 and "did you mean 'encirclement'?" in result.output


def round_with(gaps: dict[str, int]) -> Callable[[int, str], dict[str, Any]]:
    """Returns what a round of `standstill` found, however short it was."""
    return lambda seed, dumps: {"seed": seed, "gaps": gaps, "looks": 700, "late": 1}


@pytest.mark.parametrize(("gaps", "code"), [({}, 0), ({"pool": 1, "thin": 2}, 1)])
def test_a_standstill_gives_exit_code_1(monkeypatch: pytest.MonkeyPatch, gaps: dict[str, int], code: int) -> None:
    monkeypatch.setattr(standstill_command, "run_round", round_with(gaps))
    monkeypatch.setattr(standstill_command, "time", SimpleNamespace(monotonic=iter(range(100)).__next__))
    result = CliRunner().invoke(command.torture, ["standstill", "--seconds", "3"])
    assert result.exit_code == code
    assert "2 rounds, " + ("6" if code else "0") + " gaps above 0.15 s" in result.output


@pytest.mark.parametrize(("commands", "code"), [([0, 1], 0), ([1, 2], 1)])
def test_more_than_one_late_command_after_a_stop_gives_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, commands: list[int], code: int
) -> None:
    def two(directory: Path, stops: int, fleets: int, seed: int) -> LateTally:
        assert (stops, fleets) == (2, 2)
        return LateTally(2, commands, [30, 0], [1, 0], [0, 0], 500, [0.1, 0.2])

    monkeypatch.setattr(gate_command, "run_late_acts", two)
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["gate", "--stops", "3", "--json", str(path)])
    assert result.exit_code == code
    assert f"late: {sum(commands)} commands, 30 packets in 1 sends, 0 checkpoints" in result.output
    assert json.loads(path.read_text())["most"] == max(commands)
