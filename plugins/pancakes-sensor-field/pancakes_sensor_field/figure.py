"""`paths.png`: a mission in a sensor field. Places, temperatures, alarms, and what was saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.figure import INK, drawing
from pancakes_sensor_field.record import Record, Row, Table, find_task, read_record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#777777")
"""Of the nodes, in order: colours that colour-blind people can tell apart (Okabe and Ito)."""
_GREY, _FAINT, _ALARM = "#666666", "#b0b0b0", "#f4d3cb"
_LABEL_PERCENT = 15.0
"""Batteries that end within this distance of each other share a label."""


def draw_sensor_field(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw a mission.

    Args:
        run: the mission; `paths.png` is written to its folder.
        summary: what the verdict returned.

    Raises:
        PancakesError: matplotlib is missing, or the mission's files cannot be read.
    """
    record = read_record(run.out)
    field = find_task(run.configs, "sensor_field.Field")[2]["settings"]
    rule = find_task(run.configs, "sensor_field.Alarm")[2].get("migrate") or {}
    colours = dict(zip(field["nodes"], COLOURS * len(field["nodes"]), strict=False))
    with drawing(7.2, 7.6, legend_fontsize=7) as figure:
        grid = figure.add_gridspec(4, 2, height_ratios=(2.3, 1.5, 1.5, 1.3), width_ratios=(1.25, 1.0))
        _map(figure.add_subplot(grid[0, 0]), field, colours)
        _energy(figure.add_subplot(grid[0, 1]), summary["energy"], colours)
        heat = figure.add_subplot(grid[1, :])
        _heat(heat, record, colours, summary, run.ended_s)
        awake = figure.add_subplot(grid[2, :], sharex=heat)
        _awake(awake, record, colours, summary, run.ended_s)
        _batteries(figure.add_subplot(grid[3, :], sharex=heat), record, colours, summary, rule, run.ended_s)
        figure.savefig(run.out / "paths.png", dpi=200)


def _map(axes: Axes, field: Table, colours: Mapping[str, str]) -> None:
    """Draw the nodes, the paths of persons, and the fires."""
    from matplotlib.patches import Circle

    axes.set_aspect("equal")
    for fire in field["fires"].values():
        axes.add_patch(Circle((fire["x_m"], fire["y_m"]), 1.0, fc="#e8492a", ec="none", alpha=0.45, zorder=1))
    for name, walker in field["walkers"].items():
        xs, ys = [x for _, x, _ in walker["way"]], [y for _, _, y in walker["way"]]
        axes.plot(xs, ys, ls=(0, (2, 1.5)), lw=0.8, color=_GREY, zorder=2)
        axes.annotate(name, (xs[0], ys[0]), xytext=(2, 3), textcoords="offset points", fontsize=6.5, color=_GREY)
    for name, node in field["nodes"].items():
        tiny = node.get("battery") is None
        if name != "gateway":
            reach = Circle((node["x_m"], node["y_m"]), node.get("sees_m", 3.0), fc=colours[name], ec="none", alpha=0.08)
            axes.add_patch(reach)
        axes.plot(
            node["x_m"],
            node["y_m"],
            "o" if tiny else "s",
            ms=4.5 if tiny else 7,
            mfc=colours[name],
            mec="white",
            zorder=4,
        )
        axes.annotate(
            name,
            (node["x_m"], node["y_m"]),
            xytext=(0, -9),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=7,
        )
    axes.margins(0.04)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title("agents (squares), tiny nodes (dots), fires, ways")


def _energy(axes: Axes, energy: Mapping[str, Table], colours: Mapping[str, str]) -> None:
    """Draw the energy that each sleeping node used, and what it would have used always on."""
    for place, (name, used) in enumerate(energy.items()):
        axes.barh(place, used["always_on_j"], 0.62, color="none", ec=_GREY, lw=0.8, ls="--")
        axes.barh(place, used["spent_j"], 0.62, color=colours[name])
        axes.annotate(
            f"{used['saved_share']:.0%} saved",
            (used["always_on_j"], place),
            xytext=(-3, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=7,
        )
    axes.set_yticks(range(len(energy)), list(energy))
    axes.set_ylim(len(energy) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("energy [J]; dashed: always on")
    axes.set_title("what duty cycling saves")
    _bare(axes)


def _heat(axes: Axes, record: Record, colours: Mapping[str, str], summary: Table, end_s: float) -> None:
    """Draw the temperature at each node, and the alarms."""
    for name, rows in record.nodes.items():
        if name != "gateway":
            axes.plot([row.t_s for row in rows], [row.celsius for row in rows], color=colours[name], lw=1.1, label=name)
    _alarms(axes, summary, end_s, named=True)
    axes.set_ylabel("temperature [°C]")
    axes.legend(loc="upper left", ncols=3, frameon=False, handlelength=1.4, columnspacing=1.0)
    axes.tick_params(labelbottom=False)
    axes.set_xlim(0.0, end_s)
    _bare(axes)


def _awake(axes: Axes, record: Record, colours: Mapping[str, str], summary: Table, end_s: float) -> None:
    """Draw when each node saw motion, when its radio listened, and which agent had the alarm."""
    names = [name for name in record.nodes if name != "gateway"]
    lanes = ["alarm", *names]
    for holder in summary["holders"]:
        width_s = holder["end_s"] - holder["start_s"]
        axes.broken_barh([(holder["start_s"], width_s)], (-0.36, 0.72), color=colours[holder["agent"]], lw=0)
        middle_s = holder["start_s"] + 0.5 * width_s
        axes.annotate(holder["agent"], (middle_s, 0), ha="center", va="center", color="white", fontsize=7)
    for place, name in enumerate(names, start=1):
        rows = record.nodes[name]
        listening = _spans(rows, [row.listening is not False for row in rows])
        axes.broken_barh(listening, (place - 0.3, 0.6), color=colours[name], alpha=0.35, lw=0)
        axes.broken_barh(_spans(rows, [row.moving for row in rows]), (place - 0.3, 0.6), color=INK, lw=0)
    axes.set_yticks(range(len(lanes)), lanes)
    axes.set_ylim(len(lanes) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelbottom=False)
    axes.set_title(
        "which agent has the alarm; whose radio listens (colour), which node has motion before it (black)", loc="left"
    )
    _alarms(axes, summary, end_s)
    _bare(axes)


def _batteries(
    axes: Axes, record: Record, colours: Mapping[str, str], summary: Table, rule: Table, end_s: float
) -> None:
    """Draw what is left of each battery, and the level at which the alarm migrates."""
    labels: list[tuple[float, list[str]]] = []
    for name, rows in record.nodes.items():
        levels = [(row.t_s, 100.0 * row.level) for row in rows if row.level is not None]
        if levels:
            axes.plot(*zip(*levels, strict=True), color=colours[name], lw=1.1)
            near = next((names for level, names in labels if abs(level - levels[-1][1]) < _LABEL_PERCENT), None)
            if near is None:
                labels.append((levels[-1][1], [name]))
            else:
                near.append(name)
    for level, names in labels:
        where: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "annotation_clip": False}
        axes.annotate("\n".join(names), (end_s, level), va="center", fontsize=6.5, linespacing=0.95, **where)
    if rule.get("below") is not None:
        axes.axhline(100.0 * rule["below"], color=INK, lw=0.6, ls=":")
    _alarms(axes, summary, end_s)
    axes.set_ylabel("battery [%]")
    axes.set_xlabel("mission time [s]")
    axes.margins(y=0.1)
    _bare(axes)


def _alarms(axes: Axes, summary: Table, end_s: float, named: bool = False) -> None:
    for alarm in summary["alarms"]:
        until_s = alarm["cleared_s"] if alarm["cleared_s"] is not None else end_s
        axes.axvspan(alarm["raised_s"], until_s, color=_ALARM, lw=0, zorder=0)
        if named:
            axes.annotate(
                f"alarm {alarm['number']}",
                (alarm["raised_s"], 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2, 1),
                textcoords="offset points",
                va="bottom",
                fontsize=7,
            )


def _spans(rows: Sequence[Row], holds: Sequence[bool]) -> list[tuple[float, float]]:
    """Return (start, duration) of the times in which a condition holds."""
    spans: list[tuple[float, float]] = []
    since_s: float | None = None
    for row, now in zip(rows, holds, strict=True):
        if now and since_s is None:
            since_s = row.t_s
        elif not now and since_s is not None:
            spans.append((since_s, row.t_s - since_s))
            since_s = None
    if since_s is not None and rows:
        spans.append((since_s, rows[-1].t_s - since_s))
    return spans


def _bare(axes: Axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
