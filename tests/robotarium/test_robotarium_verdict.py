"""The verdict on a mission in the Robotarium needs both judges. Needs no simulator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pancakes_robotarium.verdict import read_verdict

from pancakes.errors import PancakesError

CLEAN = {"steps": 9000, "collision": 0, "boundary": 0, "actuator": 0, "other": 0}


def written(folder: Path, found: Any) -> Path:
    path = folder / "robotarium.json"
    path.write_text(found if isinstance(found, str) else json.dumps(found))
    return path


def test_clean_counts_fail_nothing(tmp_path: Path) -> None:
    found, reasons = read_verdict(written(tmp_path, {"rps": "0.0.0", "counts": CLEAN, "said": []}))
    assert reasons == [] and found is not None and found["counts"]["steps"] == 9000


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ({"collision": 3}, "two of its robots were too near to each other in 3 steps"),
        ({"boundary": 4}, "a robot was outside its floor in 4 steps"),
        ({"actuator": 5}, "wheels were commanded to run too fast in 5 steps"),
        ({"other": 6}, "it has 6 other complaints"),
    ],
)
def test_each_count_of_its_judge_fails_the_mission(counts: dict[str, int], said: str, tmp_path: Path) -> None:
    _, reasons = read_verdict(written(tmp_path, {"counts": {**CLEAN, **counts}}))
    assert reasons == [f"the Robotarium's judge: {said}"]


def test_missing_verdict_fails_the_mission(tmp_path: Path) -> None:
    found, (reason,) = read_verdict(tmp_path / "robotarium.json")
    assert found is None and "left no verdict" in reason


def test_laboratory_that_tells_no_counts_fails_the_mission(tmp_path: Path) -> None:
    _, (reason,) = read_verdict(written(tmp_path, {"counts": None}))
    assert "does not tell what it counted" in reason


@pytest.mark.parametrize("text", ["", "[]", '{"counts": {}}', '{"counts": {"collision": "many"}}', "{"])
def test_file_that_is_no_verdict_is_named(text: str, tmp_path: Path) -> None:
    with pytest.raises(PancakesError, match=r"robotarium\.json is no verdict of the Robotarium's simulator"):
        read_verdict(written(tmp_path, text))
