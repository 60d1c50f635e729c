"""The demo of this distribution, as the launcher finds it by entry point (`pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pancakes.tools.demo import Demo, Run
from pancakes_robotarium.verdict import VERDICT, judge_robotarium


def _draw(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_encirclement
    from pancakes_robotarium.figure import draw_frames

    draw_encirclement(run, summary)
    draw_frames(run, summary)


ROBOTARIUM: Final = Demo(
    name="robotarium",
    title="the encirclement in the Robotarium, judged by its own simulator too",
    agents=("world", "agent1", "agent2", "sensor"),
    configs=Path(__file__).parent / "configs" / "robotarium",
    duration_s=300.0,
    judge=judge_robotarium,
    draw=_draw,
    circled="sensor",
    radius_m=0.4,
    records={"Trajectory": "trajectory.csv", "World": VERDICT},
)
"""The tasks of the paper, unchanged, in the laboratory of its author."""
