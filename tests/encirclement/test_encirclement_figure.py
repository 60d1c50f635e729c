"""`paths.png`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pancakes_encirclement.figure import draw_encirclement
from pancakes_encirclement.verdict import judge_encirclement


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    return tmp_path / "out" / "paths.png"


def size_of(picture: Path) -> tuple[int, int]:
    head = picture.read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def test_figure_is_large_enough_for_a_paper(mission: Any, picture: Path) -> None:
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    width, height = size_of(picture)
    assert width >= 1400
    assert height >= 800


def test_figure_of_a_mission_without_hand_over(mission: Any, picture: Path) -> None:
    for kind in ("task_frozen", "task_stopped", "task_arrived", "task_started"):
        mission.forget(kind)
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    assert size_of(picture)


def test_figure_of_a_mission_that_broke_off(mission: Any, picture: Path) -> None:
    mission.events, mission.end_s, mission.ended_because = [], 0.1, "the world is gone"
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    assert size_of(picture)
