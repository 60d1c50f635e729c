"""The moving picture of the README is drawn from a mission."""

from __future__ import annotations

import importlib
import json
import math
import re
import sys
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

LIB = Path(__file__).resolve().parents[2] / "scripts" / "lib"
MOVED_S = 50.0


@pytest.fixture(scope="module")
def picture() -> ModuleType:
    sys.path.insert(0, str(LIB))
    try:
        return importlib.import_module("picture")
    finally:
        sys.path.remove(str(LIB))


@pytest.fixture
def mission(tmp_path):
    """agent1 circles, agent2 stands; at `MOVED_S` the task goes from the first to the second."""
    rows = ["t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"]
    for tenth in range(1000):
        turn = math.remainder(tenth / 100, math.tau)
        rows.append(f"{tenth / 10},agent1,{math.cos(turn)},{math.sin(turn)},{turn},0,0,{8.4 - tenth / 1000},")
        rows.append(f"{tenth / 10},agent2,1,-1,0,0,0,8.4,")
    (tmp_path / "trajectory.csv").write_text("\n".join(rows) + "\n")
    events = [
        {"t_s": MOVED_S - 0.02, "kind": "migration_asked", "task": "ScanTarget"},
        {"t_s": MOVED_S - 0.01, "kind": "migration_bid", "task": "ScanTarget", "cost": 3.0},
        {"t_s": MOVED_S - 0.01, "kind": "migration_refused", "task": "ScanTarget", "reason": "lacks motors"},
        {"t_s": MOVED_S, "kind": "task_arrived", "task": "ScanTarget", "state": {"revolutions": 1.3}},
    ]
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    return tmp_path


def test_picture_says_who_was_asked_and_what_was_answered(picture, mission):
    drawn = picture.Picture(picture.read(mission)).draw()
    words = [element.text for element in ElementTree.fromstring(drawn).iter("{http://www.w3.org/2000/svg}text")]
    assert {"bid: cost 3", "refused: lacks motors", "GoHome", "ScanTarget"} <= set(words)
    assert "The task moves with its state, 1.3 turns, in 20 ms of mission time." in words


def test_picture_of_a_mission_is_always_the_same(picture, mission):
    assert picture.Picture(picture.read(mission)).draw() == picture.Picture(picture.read(mission)).draw()


def test_picture_never_turns_a_robot_the_long_way_round(picture, mission):
    drawn = picture.Picture(picture.read(mission)).draw()
    (frames,) = (line for line in re.findall(r"@keyframes \w+\{(.*)\}", drawn) if line.count("rotate") > 50)
    angles = [float(angle) for angle in re.findall(r"rotate\((-?\d+)deg\)", frames)]
    assert max(abs(one - other) for one, other in zip(angles, angles[1:], strict=False)) < 90


def test_picture_stands_still_for_the_hand_off(picture, mission):
    drawn = picture.Picture(picture.read(mission))
    assert drawn.mission_time(picture.RUNS_S) == drawn.mission_time(picture.RUNS_S + picture.STANDS_S) == MOVED_S
    assert drawn.mission_time(picture.LOOP_S) == pytest.approx(MOVED_S + picture.AFTER_S)
