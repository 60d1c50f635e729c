"""`paths.png`: a mission as the paper shows it (Figures 4 to 6), with each agent's tasks and the batteries below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.figure import INK, drawing
from pancakes.tools.demo.mission_record import holders
from pancakes_encirclement.record import Record, Row, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Of the robots, in order: colours that colour-blind people can tell apart (Okabe and Ito)."""
_MARKERS = ("^", "s", "D", "v")
_GREY, _FAINT = "#666666", "#b0b0b0"
_DASHES = (0, (2, 1.5))
_ARROW_EVERY_M = 0.9
_HAND_OVER_S = 40.0
"""How much of the mission the middle panel shows, from the hand-over on."""


def draw_encirclement(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw a mission in which `ScanTarget` was handed over: before, at and after that.

    Args:
        run: the mission; `paths.png` is written to its folder.
        summary: what the verdict returned.

    Raises:
        PancakesError: matplotlib is missing, or the mission's files cannot be read.
    """
    end_s = run.ended_s
    held = summary["holders"]
    moved_s = held[1]["start_s"] if len(held) > 1 else end_s
    settled_s = min(moved_s + _HAND_OVER_S, end_s)
    panels = [("before the hand-over", 0.0, moved_s)]
    if moved_s < end_s:
        panels += [("at the hand-over", moved_s, settled_s), ("after it", settled_s, end_s)]
    _draw(run, summary, panels, follows=False)


def draw_intruder(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw a mission in which the circle follows an intruder; see `draw_encirclement`."""
    end_s = run.ended_s
    start_s = summary["holders"][0]["start_s"] if summary["holders"] else 0.0
    third_s = (end_s - start_s) / 3.0
    names = ("motion is sensed", "the intruder walks on", "the circle follows")
    panels = [
        (name, start_s + index * third_s if index else 0.0, start_s + (index + 1) * third_s)
        for index, name in enumerate(names)
    ]
    _draw(run, summary, panels, follows=True)


def draw_rescue(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw a mission in which the circling robot is killed and comes back; see `draw_encirclement`."""
    end_s, old = run.ended_s, summary["lost"]
    lost_s = min(summary["lost_s"] if summary["lost_s"] is not None else end_s, end_s)
    returned_s = min(summary["returned_s"] if summary["returned_s"] is not None else end_s, end_s)
    panels = [(f"until {old} is killed", 0.0, lost_s)]
    if lost_s < end_s:
        panels.append((f"{summary['taken_by'] or 'no agent'} goes on", lost_s, returned_s))
    if returned_s < end_s:
        panels.append((f"{old} is back", returned_s, end_s))
    _draw(run, summary, panels, follows=False)


def _draw(run: Run, summary: Mapping[str, Any], panels: Sequence[tuple[str, float, float]], follows: bool) -> None:
    record, scenario = read_record(run.out), read_scenario(run.configs)
    end_s = run.ended_s
    lanes = _lanes(record, run.configs, end_s)
    map_height = 2.05 * scenario.half_height_m / scenario.half_width_m
    heights = (map_height, 0.17 * max(len(lanes), 1), 0.95)
    with drawing(7.2, sum(heights) + 1.75, axes_titlesize=9) as figure:
        grid = figure.add_gridspec(3, len(panels), height_ratios=heights)
        maps: list[Axes] = []
        for index, (name, from_s, to_s) in enumerate(panels):
            axes = figure.add_subplot(grid[0, index], sharey=maps[0] if maps else None)
            _map(axes, record, scenario, summary, from_s, to_s, follows)
            axes.set_title(f"({'abcdef'[index]}) {name}\n{from_s:.0f} to {to_s:.0f} s")
            if index:
                axes.tick_params(labelleft=False)
            else:
                axes.set_ylabel("y [m]")
            maps.append(axes)
        handles, labels = _legend(scenario, follows, killed=summary.get("lost_s") is not None)
        figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), frameon=False, handlelength=1.6)
        gantt = figure.add_subplot(grid[1, :])
        _gantt(gantt, lanes, scenario, panels, end_s)
        lower = figure.add_subplot(grid[2, :], sharex=gantt)
        if "lost" in summary:
            _loss(gantt, maps, summary, record, end_s)
            _distances(lower, record, scenario, summary)
        else:
            _batteries(lower, record, scenario)
        lower.set_xlabel("mission time [s]")
        _time_axis(lower, panels, end_s)
        figure.savefig(run.out / "paths.png", dpi=200)


def _map(
    axes: Axes,
    record: Record,
    scenario: Scenario,
    summary: Mapping[str, Any],
    from_s: float,
    to_s: float,
    follows: bool,
) -> None:
    """Draw the paths of all bodies in a part of the mission."""
    from matplotlib.patches import Circle

    axes.set_aspect("equal")
    axes.set_xlim(-scenario.half_width_m, scenario.half_width_m)
    axes.set_ylim(-scenario.half_height_m, scenario.half_height_m)
    axes.set_xlabel("x [m]")
    for mover in scenario.movers:
        part = _between(record.paths.get(mover, ()), from_s, to_s)
        colour, width = (_GREY, 0.8) if follows else (_FAINT, 0.5)
        axes.plot([row.x_m for row in part], [row.y_m for row in part], ls=_DASHES, lw=width, color=colour, zorder=1)
        if follows and part:
            axes.plot(part[-1].x_m, part[-1].y_m, "o", ms=5, color=_GREY, zorder=3)
    for centre in _centres(record, summary, from_s, to_s, follows):
        axes.add_patch(Circle(centre, scenario.radius_m, fill=False, ls="--", lw=0.7, ec=INK, zorder=2.8))
    sensor = record.paths.get(scenario.sensor)
    if sensor:
        axes.plot(sensor[0].x_m, sensor[0].y_m, "D", ms=5, mfc="white", mec=INK, mew=1.0, zorder=4)
    for index, robot in enumerate(scenario.robots):
        path = record.paths.get(robot)
        if path:
            _path(axes, path, from_s, to_s, index)


def _path(axes: Axes, path: Sequence[Row], from_s: float, to_s: float, index: int) -> None:
    """Draw a robot's path: its home, its line with directions, and where it is at the end."""
    colour, marker = COLOURS[index % len(COLOURS)], _MARKERS[index % len(_MARKERS)]
    axes.plot(path[0].x_m, path[0].y_m, "+", ms=8, mew=1.2, color=colour, zorder=2)
    part = _between(path, from_s, to_s)
    if not part:
        return
    axes.plot([row.x_m for row in part], [row.y_m for row in part], lw=0.9, color=colour, zorder=2.5)
    gone_m = 0.5 * _ARROW_EVERY_M
    for before, row in pairwise(part):
        gone_m += math.hypot(row.x_m - before.x_m, row.y_m - before.y_m)
        if gone_m >= _ARROW_EVERY_M:
            gone_m = 0.0
            axes.annotate(
                "",
                xy=(row.x_m + 0.01 * math.cos(row.theta_rad), row.y_m + 0.01 * math.sin(row.theta_rad)),
                xytext=(row.x_m, row.y_m),
                arrowprops={"arrowstyle": "-|>,head_width=0.22,head_length=0.44", "color": colour, "lw": 0},
                zorder=2.6,
            )
    axes.plot(part[-1].x_m, part[-1].y_m, marker, ms=5.5, mfc=colour, mec="white", mew=0.6, zorder=5)


def _centres(
    record: Record, summary: Mapping[str, Any], from_s: float, to_s: float, follows: bool
) -> list[tuple[float, float]]:
    if not follows:
        circle = summary["circle"]
        return [] if circle["x_m"] is None else [(circle["x_m"], circle["y_m"])]
    told = [event for kind in ("alarm", "new_centre") for event in record.told(kind) if event.t_s <= to_s]
    told.sort(key=lambda event: event.t_s)
    return [(event.fields["x_m"], event.fields["y_m"]) for event in told[-1:] if to_s > from_s]


def _legend(scenario: Scenario, follows: bool, killed: bool) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=COLOURS[i % len(COLOURS)], marker=_MARKERS[i % len(_MARKERS)], ms=5, lw=0.9, mec="white")
        for i in range(len(scenario.robots))
    ]
    labels = list(scenario.robots)
    handles.append(Line2D([], [], marker="D", ms=5, mfc="white", mec=INK, lw=0))
    labels.append(f"{scenario.sensor} node" if scenario.sensor == "sensor" else scenario.sensor)
    handles += [Line2D([], [], color=INK, ls="--", lw=0.7), Line2D([], [], marker="+", ms=7, color=INK, lw=0)]
    labels += [f"circle, R = {scenario.radius_m:g} m", "start"]
    for mover in scenario.movers[:1]:
        handles.append(Line2D([], [], color=_GREY if follows else _FAINT, ls=_DASHES, lw=0.8))
        labels.append(mover)
    if killed:
        handles.append(Line2D([], [], marker="x", ms=6, mew=1.4, color=INK, lw=0))
        labels.append("killed")
    return handles, labels


def _lanes(
    record: Record, configs: Mapping[str, Any], end_s: float
) -> list[tuple[str, str, list[tuple[float, float]]]]:
    """Return (agent, task, spans) for each task of this distribution that ran on an agent."""
    names = [
        name
        for config in configs.values()
        for name, task in config["tasks"].items()
        if str(task["type"]).startswith("encirclement.")
    ]
    held = {name: holders(record, name, end_s) for name in dict.fromkeys(names)}
    lanes = []
    for agent in configs:
        for name, all_spans in held.items():
            spans = [(span.start_s, span.end_s) for span in all_spans if span.agent == agent]
            if spans:
                lanes.append((agent, name, spans))
    return lanes


def _gantt(
    axes: Axes,
    lanes: Sequence[tuple[str, str, list[tuple[float, float]]]],
    scenario: Scenario,
    panels: Sequence[tuple[str, float, float]],
    end_s: float,
) -> None:
    """Draw which agent ran which task, and when."""
    for place, (agent, task, spans) in enumerate(lanes):
        known = agent in scenario.robots
        colour = COLOURS[scenario.robots.index(agent) % len(COLOURS)] if known else "#777777"
        drives = task in (scenario.scan, scenario.home)
        bars = [(start, max(stop - start, 0.002 * end_s)) for start, stop in spans]
        axes.broken_barh(bars, (place - 0.36, 0.72), color=colour, alpha=1.0 if drives else 0.4, lw=0)
    axes.set_yticks(range(len(lanes)), [f"{agent}  {task}" for agent, task, _ in lanes])
    axes.set_ylim(len(lanes) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelbottom=False)
    _time_axis(axes, panels, end_s)


def _loss(gantt: Axes, maps: Sequence[Axes], summary: Mapping[str, Any], record: Record, end_s: float) -> None:
    """Mark where and when a robot was killed, and for how long its agent was away."""
    lost_s, old = summary["lost_s"], summary["lost"]
    if lost_s is None:
        return
    returned_s = summary["returned_s"] if summary["returned_s"] is not None else end_s
    gantt.broken_barh(
        [(lost_s, returned_s - lost_s)], (-0.36, 0.72), facecolor="none", edgecolor=_GREY, hatch="/////", lw=0.0
    )
    gantt.annotate(
        f"← {old} is away", (returned_s, 0.0), xytext=(3, 0), textcoords="offset points", va="center", fontsize=6.5
    )
    at = next((row for row in record.paths.get(old, ()) if row.t_s >= lost_s), None)
    for axes in maps:
        if at is not None:
            axes.plot(at.x_m, at.y_m, "x", ms=7, mew=1.4, color=INK, zorder=6)


def _distances(axes: Axes, record: Record, scenario: Scenario, summary: Mapping[str, Any]) -> None:
    """Draw how far from the sensor node the robots were, and the radius of the circle."""
    circle = summary["circle"]
    for index, robot in enumerate(scenario.robots):
        rows = record.paths.get(robot, ()) if circle["x_m"] is not None else ()
        far_m = [math.hypot(row.x_m - circle["x_m"], row.y_m - circle["y_m"]) for row in rows]
        axes.plot([row.t_s for row in rows], far_m, color=COLOURS[index % len(COLOURS)], lw=1.1)
    axes.axhline(scenario.radius_m, color=INK, lw=0.5, ls="--")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("to the sensor [m]")


def _batteries(axes: Axes, record: Record, scenario: Scenario) -> None:
    """Draw the robots' batteries, as a share of their range, and the levels at which something happens."""
    for index, robot in enumerate(scenario.robots):
        full_v, empty_v = scenario.battery_v.get(robot, (1.0, 0.0))
        rows = [row for row in record.paths.get(robot, ()) if row.battery_v is not None]
        levels = [100.0 * ((row.battery_v or 0.0) - empty_v) / (full_v - empty_v) for row in rows]
        axes.plot([row.t_s for row in rows], levels, color=COLOURS[index % len(COLOURS)], lw=1.1)
    for level in scenario.watched_levels:
        axes.axhline(100.0 * level, color=INK, lw=0.5, ls=":")
        axes.annotate(
            f"{100.0 * level:.0f} %",
            (1.005, 100.0 * level),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=6.5,
        )
    axes.set_ylabel("battery [%]")
    axes.margins(y=0.12)


def _time_axis(axes: Axes, panels: Sequence[tuple[str, float, float]], end_s: float) -> None:
    axes.set_xlim(0.0, end_s)
    for _, from_s, _ in panels[1:]:
        axes.axvline(from_s, color=_FAINT, lw=0.7, zorder=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _between(path: Sequence[Row], from_s: float, to_s: float) -> list[Row]:
    return [row for row in path if from_s <= row.t_s <= to_s]
