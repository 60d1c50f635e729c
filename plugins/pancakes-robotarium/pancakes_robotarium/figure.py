"""`robotarium.png`: a mission as the laboratory shows it, its floor and its golden robots, at three moments."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from pancakes import PancakesError
from pancakes.tools.demo import Run
from pancakes_encirclement.figure import COLOURS
from pancakes_encirclement.record import Row, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario
from pancakes_robotarium.gternal import DIAMETER_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GOLD: Final = "#FFD700"
_INK, _GREY = "#222222", "#8a8a8a"
TRAIL_S: Final = 40.0
"""How much of its way is drawn behind a robot."""
MARGIN_M: Final = 0.1


def draw_frames(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw the floor at the start, at the hand-over and at the end of a mission.

    Args:
        run: the mission; `robotarium.png` is written to its folder.
        summary: what the verdict returned.

    Raises:
        PancakesError: matplotlib is missing, or the mission's files cannot be read.
    """
    try:
        import matplotlib
    except ImportError:
        raise PancakesError("the figure needs matplotlib: pip install 'pancakes-agents[demo]'") from None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    record, scenario = read_record(run.out), read_scenario(run.configs)
    held = summary["holders"]
    moments = [("the robots set out", min(10.0, run.ended_s))]
    if len(held) > 1:
        moments.append((f"{held[0]['agent']} has handed over to {held[1]['agent']}", held[1]["start_s"] + 6.0))
    moments.append(("the end", run.ended_s))
    with matplotlib.rc_context({"font.size": 8, "font.family": "DejaVu Sans"}):
        size = 2.4 * (scenario.half_height_m + MARGIN_M) / (scenario.half_width_m + MARGIN_M)
        figure = Figure(figsize=(2.4 * len(moments), size + 0.2), layout="constrained")
        FigureCanvasAgg(figure)
        for place, (name, at_s) in enumerate(moments):
            axes = figure.add_subplot(1, len(moments), place + 1)
            axes.set_title(f"{name}, {at_s:.0f} s", fontsize=8)
            _floor(axes, scenario)
            _circle(axes, summary["circle"])
            for index, robot in enumerate(scenario.robots):
                _robot(axes, record.paths.get(robot, ()), at_s, COLOURS[index % len(COLOURS)], GOLD, robot)
            for guest in scenario.movers:
                _robot(axes, record.paths.get(guest, ()), at_s, _GREY, "#d9d9d9", guest)
            post = record.paths.get(scenario.sensor)
            if post:
                axes.plot(post[0].x_m, post[0].y_m, "D", ms=4, mfc="white", mec=_INK, mew=0.8, zorder=3)
        figure.savefig(run.out / "robotarium.png", dpi=200)


def _floor(axes: Axes, scenario: Scenario) -> None:
    from matplotlib.patches import Rectangle

    half_x_m, half_y_m = scenario.half_width_m, scenario.half_height_m
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_xlim(-half_x_m - MARGIN_M, half_x_m + MARGIN_M)
    axes.set_ylim(-half_y_m - MARGIN_M, half_y_m + MARGIN_M)
    axes.add_patch(Rectangle((-half_x_m, -half_y_m), 2 * half_x_m, 2 * half_y_m, fill=False, ec="black", lw=1.0))


def _circle(axes: Axes, circle: Mapping[str, Any]) -> None:
    from matplotlib.patches import Circle

    if circle["x_m"] is not None:
        centre = (circle["x_m"], circle["y_m"])
        axes.add_patch(Circle(centre, circle["radius_m"], fill=False, ls="--", lw=0.6, ec=_INK, zorder=1))


def _robot(axes: Axes, path: Sequence[Row], at_s: float, colour: str, body: str, name: str) -> None:
    """Draw a robot as the laboratory does, a square with two wheels and lights in front, and its way before."""
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.transforms import Affine2D

    end = bisect_right(path, at_s, key=lambda row: row.t_s)
    if not end:
        return
    trail, here = [row for row in path[:end] if row.t_s >= at_s - TRAIL_S], path[end - 1]
    axes.plot([row.x_m for row in trail], [row.y_m for row in trail], lw=1.0, color=colour, alpha=0.7, zorder=2)
    half_m = DIAMETER_M / 2
    turned = Affine2D().rotate(here.theta_rad).translate(here.x_m, here.y_m) + axes.transData
    for side in (-1.0, 1.0):
        wheel = Rectangle((-0.4 * half_m, side * half_m - 0.25 * half_m), 0.8 * half_m, 0.5 * half_m, fc="black")
        light = Circle((0.7 * half_m, side * 0.3 * half_m), 0.15 * half_m, fc="white", ec="black", lw=0.3)
        wheel.set_transform(turned)
        light.set_transform(turned)
        wheel.set_zorder(4)
        light.set_zorder(6)
        axes.add_patch(wheel)
        axes.add_patch(light)
    chassis = Rectangle((-half_m, -half_m), 2 * half_m, 2 * half_m, fc=body, ec="black", lw=0.6, zorder=5)
    chassis.set_transform(turned)
    axes.add_patch(chassis)
    above = -1.0 if here.y_m > 0.0 and math.hypot(here.x_m, here.y_m) > 0.8 else 1.0
    axes.annotate(name, (here.x_m, here.y_m + above * 2.6 * half_m), ha="center", va="center", fontsize=6, color=colour)
