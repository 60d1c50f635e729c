"""`energy.png`: the same mission with and without a governor: battery, power and distance from the circle over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.tools.demo import Run
from pancakes.tools.demo.figure import INK, drawing
from pancakes_encirclement.endurance import KINDS, Endurance, read_endurance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final = ("#666666", "#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Of the missions, in order: colours that colour-blind people can tell apart (Okabe and Ito)."""
_LINES: Final = ("-", "-", "-", "--", ":")
KIND_COLOURS: Final = {
    "motion": "#0072b2",
    "sensing": "#56b4e9",
    "listening": "#e69f00",
    "sending": "#f0e442",
    "idle": "#bbbbbb",
}
_FAINT = "#b0b0b0"
_OVER_S: Final = 15.0
"""Power is averaged over this time: about one sleep of the network and the time awake after it."""


def draw_energy(out: Path, runs: Mapping[str, Run], summary: Mapping[str, Any]) -> None:
    """Draw the comparison.

    Args:
        out: `energy.png` is written to this folder.
        runs: the missions, by name.
        summary: what `judge_energy` returned.

    Raises:
        PancakesError: matplotlib is missing, or a mission's files cannot be read.
    """
    measured = {name: read_endurance(run) for name, run in runs.items()}
    variants = summary["variants"]
    end_s = max(run.ended_s for run in runs.values())
    with drawing(7.2, 4.8) as figure:
        columns = figure.add_gridspec(1, 2, width_ratios=(1.9, 1.0))
        left, right = columns[0].subgridspec(3, 1), columns[1].subgridspec(2, 1)
        battery = figure.add_subplot(left[0])
        power = figure.add_subplot(left[1], sharex=battery)
        circle = figure.add_subplot(left[2], sharex=battery)
        _battery(battery, measured, variants)
        _power(power, measured)
        _circle(circle, measured)
        for axes in (battery, power):
            axes.tick_params(axis="x", labelbottom=False)
        circle.set_xlabel("mission time [s]")
        circle.set_xlim(0.0, end_s)
        _budget(figure.add_subplot(right[0]), variants)
        _spread(figure.add_subplot(right[1]), measured)
        handles, labels = battery.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
        for axes in figure.axes:
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
        figure.savefig(out / "energy.png", dpi=200)


def _battery(axes: Axes, measured: Mapping[str, Endurance], variants: Mapping[str, Any]) -> None:
    """Draw how full each battery was, and when it was empty."""
    for index, (name, run) in enumerate(measured.items()):
        points = [(t_s, 100.0 * level) for t_s, level in run.levels if t_s <= run.lasted_s]
        lasted = f"{run.lasted_s:.0f} s" if run.empty else f"over {run.lasted_s:.0f} s"
        axes.plot(*_columns(points), color=COLOURS[index], ls=_LINES[index], lw=1.2, label=f"{name}: {lasted}")
        if run.empty:
            axes.plot(run.lasted_s, 0.0, "x", color=COLOURS[index], ms=5, mew=1.4, clip_on=False, zorder=5)
    for row in variants.values():
        if row["until_s"] is not None:
            axes.axvline(row["until_s"], color=INK, lw=0.6, ls=":")
            axes.annotate(
                "wanted end",
                (row["until_s"], 0.97),
                xycoords=("data", "axes fraction"),
                xytext=(-3, 0),
                textcoords="offset points",
                ha="right",
                va="top",
                fontsize=6.5,
            )
    axes.set_title("(a) battery", loc="left")
    axes.set_ylabel("level [%]")
    axes.set_ylim(0.0, 100.0)


def _power(axes: Axes, measured: Mapping[str, Endurance]) -> None:
    """Draw what was taken from each battery."""
    for index, run in enumerate(measured.values()):
        axes.plot(*_columns(run.powers_w(_OVER_S)), color=COLOURS[index], ls=_LINES[index], lw=1.0)
    axes.set_title(f"(b) power, mean of {_OVER_S:g} s", loc="left")
    axes.set_ylabel("power [W]")
    axes.set_ylim(bottom=0.0)


def _circle(axes: Axes, measured: Mapping[str, Endurance]) -> None:
    """Draw how far from the circle round the target the robot was."""
    for index, run in enumerate(measured.values()):
        points = [(t_s, 100.0 * off) for t_s, off in run.off_m]
        axes.plot(*_columns(points), color=COLOURS[index], lw=0.35, alpha=0.35)
        axes.plot(*_columns(_averaged(points, 30.0)), color=COLOURS[index], ls=_LINES[index], lw=1.2)
    axes.set_title("(c) distance from the circle, and its mean of 30 s", loc="left")
    axes.set_ylabel("distance [cm]")
    axes.set_ylim(bottom=0.0)


def _budget(axes: Axes, variants: Mapping[str, Any]) -> None:
    """Draw what drained each battery."""
    places = range(len(variants))
    lefts = [0.0 for _ in variants]
    for kind in KINDS:
        powers = [row["mean_power_w"][kind] for row in variants.values()]
        axes.barh(places, powers, 0.5, left=lefts, color=KIND_COLOURS[kind], ec="white", lw=0.4, label=kind)
        lefts = [left + power for left, power in zip(lefts, powers, strict=True)]
    for place, total, (name, row) in zip(places, lefts, variants.items(), strict=True):
        longer = f", lasts {row['longer'] - 1.0:+.0%}" if place else ""
        axes.annotate(f"{name}: {total:.2f} W{longer}", (0.0, place - 0.3), ha="left", va="bottom", fontsize=7)
    axes.set_yticks([])
    axes.set_ylim(len(variants) + 0.35, -0.7)  # with room for the legend below
    axes.spines["left"].set_visible(False)
    axes.set_title("(d) mean power, by what took it", loc="left")
    axes.set_xlabel("power [W]")
    axes.legend(loc="lower left", ncols=3, frameon=False, handlelength=0.8, columnspacing=1.0, fontsize=6.5)


def _spread(axes: Axes, measured: Mapping[str, Endurance]) -> None:
    """Draw for how much of the time the robot was within each distance from the circle."""
    for index, run in enumerate(measured.values()):
        ordered = sorted(100.0 * off for _, off in run.off_m)
        shares = [100.0 * (place + 1) / len(ordered) for place in range(len(ordered))]
        axes.plot(ordered, shares, color=COLOURS[index], ls=_LINES[index], lw=1.2)
    axes.axhline(95.0, color=_FAINT, lw=0.6, ls=":")
    axes.set_title("(e) time within a distance", loc="left")
    axes.set_xlabel("distance from the circle [cm]")
    axes.set_ylabel("share of time [%]")
    axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 100.0)


def _averaged(points: Sequence[tuple[float, float]], over_s: float) -> list[tuple[float, float]]:
    """Return the mean of what lies within half of `over_s` before and after each point, once in a second."""
    averaged = []
    first = last = 0
    next_s = points[0][0] if points else 0.0
    for t_s, _ in points:
        if t_s < next_s:
            continue
        next_s += 1.0
        while points[first][0] < t_s - 0.5 * over_s:
            first += 1
        while last < len(points) and points[last][0] <= t_s + 0.5 * over_s:
            last += 1
        averaged.append((t_s, sum(value for _, value in points[first:last]) / (last - first)))
    return averaged


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]
