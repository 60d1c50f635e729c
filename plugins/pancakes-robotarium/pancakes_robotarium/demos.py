"""The demos of this distribution, as the launcher finds them by entry point (`pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pancakes.tools.demo import Demo, Loss, Run
from pancakes_robotarium.endless_verdict import judge_endless
from pancakes_robotarium.verdict import VERDICT, judge_robotarium


def _draw(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_encirclement
    from pancakes_robotarium.figure import draw_frames

    draw_encirclement(run, summary)
    draw_frames(run, summary)


CONFIGS: Final = Path(__file__).parent / "configs"
ROBOTS: Final = tuple(f"robot{number}" for number in range(1, 9))


def _draw_endless(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_robotarium.endless_figure import draw_endless

    draw_endless(run, summary)


ROBOTARIUM: Final = Demo(
    name="robotarium",
    title="the encirclement in the Robotarium, judged by its own simulator too",
    agents=("world", "agent1", "agent2", "sensor"),
    configs=CONFIGS / "robotarium",
    duration_s=300.0,
    judge=judge_robotarium,
    draw=_draw,
    circled="sensor",
    radius_m=0.4,
    records={"Trajectory": "trajectory.csv", "World": VERDICT},
)
"""The tasks of the paper, unchanged, in the laboratory of its author."""

ENDLESS: Final = Demo(
    name="endless",
    title="eight robots keep three circles and a patrol served while they charge, die and come back",
    agents=("world", *ROBOTS, "dock1", "dock2"),
    configs=CONFIGS / "endless",
    duration_s=21_600.0,
    judge=judge_endless,
    draw=_draw_endless,
    records={"Trajectory": "trajectory.csv", "World": VERDICT},
    virtual=True,
    loss=Loss(ROBOTS, earliest_s=600.0, latest_s=2100.0, away_s=900.0, every_s=3600.0),
    fastest=4.0,
)
"""A mission without an end, of which six hours are judged."""
