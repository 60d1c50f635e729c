"""`scripts/torture` runs missions and tells how they went; what it finds must show in its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from torture import __main__ as command
from torture.missions import Job, Outcome, fly


def test_missions_that_pass_give_exit_code_0() -> None:
    """Run as the script does it: its workers must find what they are to do."""
    ended = subprocess.run(
        [sys.executable, "-m", "torture", "missions", "--demo", "intruder", "--seeds", "2", "--jobs", "2"],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
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


def test_a_mission_that_breaks_down_fails(tmp_path: Path) -> None:
    outcome = fly(Job("no such demo", 1, tmp_path))
    assert outcome.summary["verdict"] == "FAIL"
    assert "unknown demo 'no such demo'" in outcome.summary["reasons"][0]


def test_an_unknown_demo_is_named() -> None:
    result = CliRunner().invoke(command.torture, ["missions", "--demo", "encirclment"])
    assert result.exit_code == 2 and "did you mean 'encirclement'?" in result.output
