"""`scripts/allocation`: a short run, and that it fails if an allocation is poor or a task has no owner."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from team_allocation import __main__ as command
from team_allocation.auctions import Auction
from team_allocation.fleet import Told

SHORT = ["--seeds", "2", "--robots", "3", "--tasks", "6", "--steady", "0", "--fleets", "0"]


def test_a_short_run_passes_and_writes_its_figures(tmp_path: Path) -> None:
    pytest.importorskip("highspy")
    path = tmp_path / "figures.json"
    ended = CliRunner().invoke(command.allocation, [*SHORT, "--json", str(path)])
    assert ended.exit_code == 0, ended.output
    figures = json.loads(path.read_text())
    assert figures["share"]["median"] > 0.95 and figures["failures"] == []


@pytest.mark.parametrize(
    ("poor", "sentence"),
    [
        (Auction(1, 94.0, 100.0, 1.0, True, ()), "the median round has 94.0% of the optimum's value"),
        (Auction(1, 99.0, 100.0, 1.0, True, ("a has too many",)), "round 1: a has too many"),
    ],
)
def test_a_poor_or_forbidden_round_fails(monkeypatch: pytest.MonkeyPatch, poor: Auction, sentence: str) -> None:
    monkeypatch.setattr(command, "has_solver", lambda: True)
    monkeypatch.setattr(command, "auction", lambda *_: poor)
    ended = CliRunner().invoke(command.allocation, SHORT)
    assert ended.exit_code == 1 and sentence in ended.output


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        (Told(without_owner_s=[3.6]), "a task had no owner for 3.6 s"),
        (Told(moves=9, most_moves=3), "a task moved 3 times"),
        (Told(lost=["Watch3"]), "Watch3 does not run exactly once"),
    ],
)
def test_a_fleet_that_leaves_a_hole_or_oscillates_fails(
    monkeypatch: pytest.MonkeyPatch, told: Told, sentence: str
) -> None:
    class Made:
        def __init__(self, *_: object) -> None:
            pass

        def __enter__(self) -> Made:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def run(self, hours: float, deaths: int) -> Told:
            return told

    monkeypatch.setattr(command, "Trial", Made)
    figures, failures = command.judged_fleets(1, 3, 6, 0.2, 0.1, 1)
    assert any(sentence in it for it in failures) and len(figures["fleets"]) == 1


def test_tasks_that_move_to_and_fro_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "steady_moves", lambda *_: {"a/T": 3})
    assert command.judged_hours(1, 3, 6, 0.2)[1] == ["a task moved 3 times in an hour"]
