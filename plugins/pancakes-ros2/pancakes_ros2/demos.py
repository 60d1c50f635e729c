"""The demo of this distribution, as the launcher finds it by entry point (`pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.tools.demo import Demo, Run

ARENA: Final = "ros2.arena"
WORLD: Final = "sim.world"


def _judge(run: Run) -> dict[str, Any]:
    try:
        from pancakes_encirclement.verdict import judge_encirclement
    except ImportError:
        raise PancakesError("this demo has the tasks of the encirclement: pip install pancakes-encirclement") from None

    return judge_encirclement(as_simulated(run))


def _draw(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_encirclement

    draw_encirclement(as_simulated(run), summary)


def as_simulated(run: Run) -> Run:
    """Returns a run in which the world is called what it is in the encirclement, which knows no other."""

    def told(task: Mapping[str, Any]) -> Mapping[str, Any]:
        return {**task, "type": WORLD} if task.get("type") == ARENA else task

    configs = {
        agent: {**config, "tasks": {name: told(task) for name, task in config.get("tasks", {}).items()}}
        for agent, config in run.configs.items()
    }
    return replace(run, configs=configs)


ROS2: Final = Demo(
    name="ros2",
    title="the encirclement with two robots that exist only as nodes of ROS 2",
    agents=("world", "agent1", "agent2", "sensor"),
    configs=Path(__file__).parent / "configs" / "ros2",
    duration_s=300.0,
    judge=_judge,
    draw=_draw,
    circled="sensor",
    radius_m=0.55,
    live_only="robots of ROS 2 do not live in virtual time",
)
"""The experiment of the paper, by way of ROS 2 alone."""
