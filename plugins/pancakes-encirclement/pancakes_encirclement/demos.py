"""The demos of this distribution, as the launcher finds them by entry point (`pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from pancakes.tools.demo import Comparison, Demo, Loss, Run, Variant
from pancakes_encirclement.energy_verdict import judge_energy, judge_mission
from pancakes_encirclement.intruder_verdict import judge_intruder
from pancakes_encirclement.rescue_verdict import judge_rescue
from pancakes_encirclement.verdict import Limits, judge_encirclement

CONFIGS: Final = Path(__file__).parent / "configs"
AGENTS: Final = ("world", "agent1", "agent2", "sensor")


def _draw_encirclement(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_encirclement

    draw_encirclement(run, summary)


def _draw_intruder(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_intruder

    draw_intruder(run, summary)


def _draw_rescue(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.figure import draw_rescue

    draw_rescue(run, summary)


def _draw_energy(out: Path, runs: Mapping[str, Run], summary: Mapping[str, Any]) -> None:
    from pancakes_encirclement.energy_figure import draw_energy

    draw_energy(out, runs, summary)


ENCIRCLEMENT: Final = Demo(
    name="encirclement",
    title="the experiment of the paper: two Khepera III circle a sensor node, and hand the task over",
    agents=AGENTS,
    configs=CONFIGS / "encirclement",
    duration_s=300.0,
    judge=judge_encirclement,
    draw=_draw_encirclement,
    circled="sensor",
    radius_m=0.55,
)
"""Figures 4 to 6 of the paper."""

PIONEER: Final = Demo(
    name="pioneer",
    title="the same tasks on two Pioneers 3-DX, larger and faster",
    agents=AGENTS,
    configs=CONFIGS / "pioneer",
    duration_s=300.0,
    judge=partial(judge_encirclement, limits=Limits(radius_error_m=0.03)),
    draw=_draw_encirclement,
    circled="sensor",
    radius_m=1.2,
)
"""The encirclement on other robots, only by configuration."""

INTRUDER: Final = Demo(
    name="intruder",
    title="motion starts the encirclement, and the circle follows the intruder",
    agents=AGENTS,
    configs=CONFIGS / "intruder",
    duration_s=240.0,
    judge=judge_intruder,
    draw=_draw_intruder,
    circled="intruder",
    radius_m=0.55,
)
"""Figure 1 of the paper."""

RESCUE: Final = Demo(
    name="rescue",
    title="the robot that circles is killed, another goes on with its circle, and the first comes back",
    agents=AGENTS,
    configs=CONFIGS / "rescue",
    duration_s=300.0,
    judge=judge_rescue,
    draw=_draw_rescue,
    circled="sensor",
    radius_m=0.55,
    loss=Loss(("agent1",), earliest_s=70.0, latest_s=110.0, away_s=60.0),
    fastest=12.0,
)
"""A task that outlives its robot."""

ENERGY: Final = Comparison(
    name="energy",
    title="how much longer a battery lasts under an energy governor, and what that costs",
    mission=Demo(
        name="energy",
        title="a Khepera III goes round a person that walks about, until its battery is empty",
        agents=("world", "agent1", "sensor"),
        configs=CONFIGS / "energy",
        duration_s=540.0,
        judge=judge_mission,
        circled="intruder",
        radius_m=0.55,
        records={"Trajectory": "trajectory.csv", "Consumption": "consumption.csv"},
    ),
    variants=(
        Variant("plain", "without a governor", ("agent1:task.EnergyGovernor.start=false",)),
        Variant("thresholds", "governed by thresholds", ('agent1:task.EnergyGovernor.settings.policy="thresholds"',)),
        Variant("feedback", "governed by feedback", ('agent1:task.EnergyGovernor.settings.policy="feedback"',)),
    ),
    judge=judge_energy,
    draw=_draw_energy,
    picture="energy.png",
)
"""The paper's point, a longer mission (§3.4), measured."""
