"""`scripts/torture collisions` and `halts`: a sound barrier passes, a broken one is convicted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from torture import collisions, safety_commands
from torture.halts import Halting

from pancakes.filters import barrier
from pancakes.filters.half_planes import HalfPlane


def fly(*options: str, path: Path | None = None) -> Result:
    where = ["--json", str(path)] if path is not None else []
    few = ["--missions", "4", "--length", "6", "--jobs", "1", "--judge", "own"]
    return CliRunner().invoke(safety_commands.collisions, [*few, *options, *where])


def test_barrier_keeps_robots_from_collisions(tmp_path: Path) -> None:
    """One mission of each kind; without the barrier they collide."""
    path = tmp_path / "figures.json"
    result = fly(path=path)
    assert result.exit_code == 0, result.output
    figures = json.loads(path.read_text())
    assert figures["with the barrier"]["collisions"] == 0 and figures["with the barrier"]["outside"] == 0
    assert figures["without it"]["collisions"] > 100
    assert set(figures["without it"]["missions"]) == set(collisions.KINDS)
    assert figures["with the barrier"]["driven_m"]["most"] > 0.1, "it does not keep them apart by standing"


def test_barrier_that_ignores_robots_is_convicted(monkeypatch: pytest.MonkeyPatch) -> None:
    anything = barrier.Constraint(HalfPlane(1.0, 0.0, -10.0), "nobody", 1.0)
    monkeypatch.setattr(barrier, "around_robot", lambda *arguments: anything)
    result = fly()
    assert result.exit_code == 1
    assert "seed 1, a stranger" in result.output or "seed 1, walls" in result.output


def test_barrier_that_ignores_walls_is_convicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(barrier, "inside", lambda *arguments: iter(()))
    assert fly("--first", "1", "--missions", "1", "--length", "15").exit_code == 1


def test_barrier_that_takes_long_is_convicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_commands, "MOST_S", 1e-6)
    assert fly("--missions", "1").exit_code == 1


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (Halting(("r1", "r2"), (0.1, 0.49), ()), 0),
        (Halting(("r1",), (0.1, 0.51), ()), 1),
        (Halting(("r1",), (0.1, 0.2), ("r2",)), 1),
    ],
)
def test_late_halt_is_convicted(monkeypatch: pytest.MonkeyPatch, found: Halting, code: int) -> None:
    class Spaces:
        def __enter__(self) -> tuple[str, list[str]]:
            return "spaces", []

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(safety_commands, "namespaces", lambda *arguments: Spaces())
    monkeypatch.setattr(safety_commands, "halt_often", lambda *arguments: [found])
    result = CliRunner().invoke(safety_commands.halts, [])
    assert result.exit_code == code, result.output
