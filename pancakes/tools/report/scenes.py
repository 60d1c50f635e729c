"""Pictures of the mission: paths, tasks by agent, batteries, moves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pancakes.tools.report.findings import Findings
from pancakes.tools.report.moves import TaskMove
from pancakes.tools.report.paths import Body, CommandSpan
from pancakes.tools.report.style import (
    COLOURS,
    COLUMN_IN,
    DASHES,
    FAINT,
    INK,
    WIDE_IN,
    Palette,
    Picture,
    figure,
    label_rows,
    plot_line,
    save,
    time_axis,
)
from pancakes.tools.report.task_timeline import TaskLane

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LANES = 40
MOST_DOTS = 600
MOST_NAMES = 9
MOST_MOVES = 12


def draw_paths(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws where all bodies went, and which task drove them. None where nothing has a place."""
    bodies = findings.paths.bodies()
    if not bodies:
        return None
    tasks = list(
        dict.fromkeys(it.task for name in sorted(findings.paths.commands) for it in findings.paths.commands[name])
    )
    xs = [point[1] for body in bodies for point in body.path.whole()]
    ys = [point[2] for body in bodies for point in body.path.whole()]
    wide, high = max(max(xs) - min(xs), 0.1), max(max(ys) - min(ys), 0.1)
    with figure(COLUMN_IN, min(5.0, max(1.6, 0.8 * COLUMN_IN * high / wide)) + 0.75) as made:
        axes = made.add_subplot()
        axes.set_aspect("equal", adjustable="datalim")
        for body in bodies:
            _body(axes, body, findings.paths.commands.get(body.name, []), tasks, palette)
        for name, poses in findings.paths.poses.items():
            if name in findings.paths.truth and findings.paths.truth[name].kind == "robot":
                points = poses.path.whole()
                points = points[:: max(1, len(points) // MOST_DOTS)]
                colour = palette.colour(name)
                axes.plot([p[1] for p in points], [p[2] for p in points], "o", ms=1.6, mew=0, color=colour, alpha=0.35)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        handles, labels = _path_legend(bodies, tasks, palette)
        made.legend(handles, labels, loc="outside upper center", ncols=min(3, len(handles)), handlelength=2.2)
        told = _how_known(findings, tasks)
        return save(made, out, "paths", f"Paths, {told}. Crosses: starts; markers: ends.")


def _how_known(findings: Findings, tasks: Sequence[str]) -> str:
    told = "as the agents knew them"
    if findings.paths.truth:
        told = "as the simulated world knew them"
        if findings.paths.poses:
            told += "; dots: what the robots took for their poses"
    return f"{told}; line styles: the task that commanded the wheels" if tasks else told


def _body(axes: Axes, body: Body, commands: Sequence[CommandSpan], tasks: Sequence[str], palette: Palette) -> None:
    points = body.path.whole()
    x_m, y_m = [point[1] for point in points], [point[2] for point in points]
    if body.kind == "sensor":
        axes.plot(x_m[-1:], y_m[-1:], "D", ms=5, mfc="none", mec=INK, mew=1.0, zorder=4)
        axes.annotate(
            body.name, (x_m[-1], y_m[-1]), (0, -11), textcoords="offset points", ha="center", fontsize=7, zorder=6
        )
        return
    if body.kind == "mover":
        axes.plot(x_m, y_m, lw=0.5, color=FAINT, zorder=1)
        return
    colour = palette.colour(body.name)
    if not commands:
        axes.plot(x_m, y_m, lw=0.9, color=colour, zorder=2)
    for command in commands:
        part = [point for point in points if command.from_s <= point[0] <= command.to_s]
        dashes = DASHES[tasks.index(command.task) % len(DASHES)]
        axes.plot([p[1] for p in part], [p[2] for p in part], lw=0.9, ls=dashes, color=colour, zorder=2)
    axes.plot(x_m[0], y_m[0], "+", ms=7, mew=1.1, color=colour, zorder=3)
    axes.plot(x_m[-1], y_m[-1], palette.marker(body.name), ms=5.5, mfc=colour, mec="white", mew=0.5, zorder=5)


def _path_legend(bodies: Sequence[Body], tasks: Sequence[str], palette: Palette) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    handles, labels = [], []
    for body in [body for body in bodies if body.kind not in ("sensor", "mover")][:MOST_NAMES]:
        colour = palette.colour(body.name)
        handles.append(Line2D([], [], color=colour, marker=palette.marker(body.name), ms=5, lw=0.9, mec="white"))
        labels.append(body.name)
    if any(body.kind == "sensor" for body in bodies):
        handles.append(Line2D([], [], marker="D", ms=5, mfc="none", mec=INK, lw=0))
        labels.append("sensor node")
    movers = [body.name for body in bodies if body.kind == "mover"]
    if movers:
        handles.append(Line2D([], [], color=FAINT, lw=0.7))
        labels.append(movers[0] if len(movers) == 1 else "others that move")
    for number, task in enumerate(tasks[: len(DASHES)] if len(tasks) > 1 else ()):
        handles.append(Line2D([], [], color=INK, ls=DASHES[number], lw=0.9))
        labels.append(task)
    return handles, labels


def draw_course(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws which agent ran which task. None where no task of a mission ran."""
    lanes = [lane for _, lane in sorted(findings.course.lanes.items()) if lane.spans][:MOST_LANES]
    if not lanes:
        return None
    shortest_s = 0.002 * findings.duration_s
    with figure(WIDE_IN, 0.2 * len(lanes) + 0.65) as made:
        axes = made.add_subplot()
        for place, lane in enumerate(lanes):
            bars = [(span.from_s, max(span.to_s - span.from_s, shortest_s)) for span in lane.spans]
            axes.broken_barh(bars, (place - 0.36, 0.72), color=palette.colour(lane.agent), lw=0)
            for span in lane.spans:
                if span.ended in ("failed", "given up"):
                    axes.plot(span.to_s, place, "x", ms=5, mew=1.2, color=INK, zorder=3)
        for move in findings.moves.moves:
            _arrow(axes, move, lanes)
        label_rows(axes, [f"{lane.agent}  {lane.task}" for lane in lanes])
        time_axis(axes, findings)
        moved = " Arrows: moves." if any(move.outcome == "moved" for move in findings.moves.moves) else ""
        return save(made, out, "tasks", f"Which agent ran which task. Crosses: failures.{moved}")


def _arrow(axes: Axes, move: TaskMove, lanes: Sequence[TaskLane]) -> None:
    places = {(lane.agent, lane.task): place for place, lane in enumerate(lanes)}
    begin, end = places.get((move.source, move.task)), places.get((move.winner, move.task))
    if move.outcome == "moved" and begin is not None and end is not None:
        axes.annotate(
            "",
            xy=(move.at_s, end - (0.3 if end > begin else -0.3)),
            xytext=(move.at_s, begin),
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.8, "mutation_scale": 7},
            zorder=4,
        )


def draw_batteries(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws what was left in the batteries. None where no agent has one."""
    batteries = findings.paths.batteries
    if not batteries:
        return None
    with figure(COLUMN_IN, 1.9) as made:
        axes = made.add_subplot()
        for number, (agent, series) in enumerate(sorted(batteries.items())):
            points = [(t_s, 100.0 * level) for t_s, level in series.whole()]
            plot_line(axes, points, number // len(COLOURS), palette.colour(agent), agent, lw=1.1)
        for move in findings.moves.moves[:MOST_MOVES]:
            if move.outcome == "moved":
                axes.axvline(move.at_s, color=FAINT, lw=0.7, zorder=0)
        axes.set_ylabel("battery [%]")
        axes.margins(y=0.08)
        time_axis(axes, findings)
        made.legend(loc="outside upper center", ncols=min(4, len(batteries)), handlelength=1.6)
        return save(made, out, "batteries", "What is left of the batteries' range. Vertical lines: moves of tasks.")


def draw_moves(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws what the neighbours asked for in each move. None where no neighbour was asked."""
    moves = [move for move in findings.moves.moves if any(it.cost is not None for it in move.answers)][:MOST_MOVES]
    if not moves:
        return None
    rows = [(move, it) for move in moves for it in move.answers]
    with figure(COLUMN_IN, 0.19 * len(rows) + 0.75) as made:
        axes = made.add_subplot()
        largest = max(it.cost or 0.0 for _, it in rows) or 1.0
        for place, (_, it) in enumerate(rows):
            if it.cost is None:
                axes.text(0.01 * largest, place, it.answer, va="center", fontsize=7, color=FAINT)
                continue
            won = it.fate == "won"
            colour = palette.colour(it.peer)
            axes.barh(place, it.cost, 0.6, color=colour if won else "none", ec=colour, lw=0.9)
            axes.plot(it.cost, place, "o" if won else ".", ms=4, color=colour)
            axes.text(it.cost + 0.03 * largest, place, f"{it.cost:.3g}, {it.fate}", va="center", fontsize=7)
        labels = [f"{move.task} at {move.at_s:.0f} s: {it.peer}" for move, it in rows]
        label_rows(axes, labels)
        axes.set_xlim(-0.04 * largest, 1.35 * largest)
        axes.set_xlabel("cost asked for")
        return save(
            made, out, "moves", "What neighbours asked for when a task was to move; filled: the agent that got it."
        )
