"""`paths.png`."""

from __future__ import annotations

import subprocess
import sys
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


def test_it_is_large_enough_for_a_paper(mission: Any, picture: Path) -> None:
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    width, height = size_of(picture)
    assert width >= 1400
    assert height >= 800


def test_a_mission_without_a_hand_over_can_be_drawn_too(mission: Any, picture: Path) -> None:
    for kind in ("task_frozen", "task_stopped", "task_arrived", "task_started"):
        mission.forget(kind)
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    assert size_of(picture)


def test_so_can_one_that_broke_off_at_once(mission: Any, picture: Path) -> None:
    mission.events, mission.end_s, mission.ended_because = [], 0.1, "the world is gone"
    run = mission.write()
    draw_encirclement(run, judge_encirclement(run))
    assert size_of(picture)


def test_an_agent_that_loads_the_demos_does_not_load_matplotlib() -> None:
    code = "import sys, pancakes_encirclement.demos; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
