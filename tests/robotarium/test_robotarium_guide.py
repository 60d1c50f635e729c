"""What docs/robotarium.md shows: its script, its mission, and the page with the floor of the Robotarium."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from harness.guide import example, examples

from pancakes import Simulation
from pancakes.control import Describe
from pancakes.tools.web.fleet_model import FleetModel

GUIDE = "docs/robotarium.md"
pytestmark = pytest.mark.usefixtures("robotarium")


def test_script_prints_what_it_must(capsys: pytest.CaptureFixture[str]) -> None:
    code = example(GUIDE, "from pancakes")
    exec(compile(code.text, str(code), "exec"), {})
    first, second = capsys.readouterr().out.splitlines()
    assert first == "ScanTarget runs on ['agent1']"
    x_m, y_m = (float(it) for it in second.partition("(")[2].partition(")")[0].split(", "))
    assert math.hypot(x_m, y_m) == pytest.approx(0.4, abs=0.15), "it is on its circle"


def test_mission_of_the_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # where the verdict is written
    with Simulation() as simulation:
        for block in examples(GUIDE):
            if block.text.startswith(("# world.toml", "# robot1.toml")):
                path = tmp_path / block.text.splitlines()[0].removeprefix("# ")
                path.write_text(block.text)
                simulation.load(path)
        simulation.reset(seed=1)
        simulation.step(20.0)
        robot = simulation.body("robot1")
        assert math.hypot(robot.x_m - 0.8, robot.y_m) < 0.1
        assert simulation.agents["world"].events("collision") == []


def test_page_has_the_floor_and_the_robots_of_the_robotarium() -> None:
    with Simulation.of_demo("robotarium") as simulation:
        simulation.reset(seed=1)
        description: dict[str, Any] = simulation.agents["world"].ask(Describe("World")).result
    model = FleetModel()
    model.detail("world", description)
    assert model.board.get("arena") == [3.2, 2.0]
    assert model.board.get("shape/agent1") == {"kind": "robot", "radius_m": 0.055}
    assert model.board.get("shape/guest") == {"kind": "mover", "radius_m": 0.055}
