"""`endless.svg`: who did what, the docks, the batteries and the deaths of a mission without an end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from pancakes import PancakesError, agent_of
from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import Holder, MissionRecord, holders
from pancakes.worlds import robot_model
from pancakes_encirclement.record import Row, read_record
from pancakes_encirclement.scenario import find_world
from pancakes_robotarium.endless_verdict import read_duties

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TASK_COLOURS: Final = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
CHARGES: Final = "#8a8a8a"
_INK: Final = "#222222"
EVERY: Final = 20
"""Every how-manieth row of a battery is drawn."""
DOCKS_BELOW: Final = 0.4
"""How far the lanes of the docks are moved away from those of the robots, for their numbers."""


def charges_of(record: MissionRecord, end_s: float) -> list[tuple[str, Holder]]:
    """Return which robot stood at which dock, from when until when."""
    found: list[tuple[str, Holder]] = []
    since: dict[str, tuple[str, float]] = {}
    for event in record.events:
        if event.kind == "docked":
            since[event.agent] = (agent_of(str(event.fields.get("dock", ""))), event.t_s)
        elif event.kind in ("charged", "dock_lost", "agent_lost") and event.agent in since:
            dock, start_s = since.pop(event.agent)
            found.append((dock, Holder(event.agent, start_s, event.t_s)))
    found += [(dock, Holder(agent, start_s, end_s)) for agent, (dock, start_s) in since.items()]
    return found


def deaths_of(record: MissionRecord, end_s: float) -> list[Holder]:
    """Return from when until when each agent was gone."""
    found = []
    since: dict[str, float] = {}
    for event in record.events:
        if event.kind == "agent_lost":
            since[event.agent] = event.t_s
        elif event.kind == "agent_returned" and event.agent in since:
            found.append(Holder(event.agent, since.pop(event.agent), event.t_s))
    return found + [Holder(agent, start_s, end_s) for agent, start_s in since.items()]


def draw_endless(run: Run, summary: Mapping[str, Any]) -> None:
    """Draw a mission.

    Args:
        run: the mission; `endless.svg` and `endless.png` are written to its folder.
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

    record, world = read_record(run.out), find_world(run.configs)
    robots = list(world.robots)
    colours = {
        duty.name: TASK_COLOURS[place % len(TASK_COLOURS)] for place, duty in enumerate(read_duties(run.configs))
    }
    with matplotlib.rc_context({"font.size": 8, "font.family": "DejaVu Sans", "svg.hashsalt": "endless"}):
        figure = Figure(figsize=(8.0, 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        lanes, levels = figure.subplots(2, 1, sharex=True, height_ratios=[1.9, 1.0])
        _lanes(lanes, record, robots, colours, run.ended_s)
        for robot in robots:
            model = robot_model(world.robots[robot].model)
            _level(levels, record.paths.get(robot, ()), model.empty_v, model.full_v)
        for death in deaths_of(record, run.ended_s):
            for axes in (lanes, levels):
                axes.axvline(death.start_s / 3600.0, color=_INK, lw=0.6, ls=":", zorder=0)
        levels.set_ylim(0.0, 1.0)
        levels.set_yticks([0.0, 0.5, 1.0], ["empty", "50 %", "full"])
        levels.set_ylabel("batteries")
        levels.set_xlabel("mission time in h")
        levels.set_xlim(0.0, run.ended_s / 3600.0)
        lanes.set_title(
            f"seed {run.seed}, {run.ended_s / 3600.0:.3g} h, {summary['verdict']}:"
            f" tasks served for {100.0 * summary['served']:.2f} % of the time; deaths: {len(summary['deaths'])},"
            f" charges: {summary['charges']}, lowest battery: {100.0 * (summary['lowest_level'] or 0.0):.0f} %",
            fontsize=8,
        )
        for name in ("endless.svg", "endless.png"):
            figure.savefig(run.out / name, dpi=150, metadata={"Date": None} if name.endswith("svg") else None)


def _lanes(axes: Axes, record: MissionRecord, robots: Sequence[str], colours: Mapping[str, str], end_s: float) -> None:
    """Draw a lane for each robot, with its task, its charges and its deaths, and one for each dock."""
    charges = charges_of(record, end_s)
    docks = sorted({dock for dock, _ in charges})
    lanes = {robot: float(place) for place, robot in enumerate(robots)}
    lanes |= {dock: len(robots) + DOCKS_BELOW + place for place, dock in enumerate(docks)}
    for task, colour in colours.items():
        for place, stay in enumerate(holders(record, task, end_s)):
            _bar(axes, lanes, stay.agent, stay, colour, label="" if place else task)
    for place, (dock, stay) in enumerate(charges):
        _bar(axes, lanes, stay.agent, stay, CHARGES, label="" if place else "charges", height=0.4)
        _bar(axes, lanes, dock, stay, CHARGES, height=0.4)
        axes.annotate(
            stay.agent.removeprefix("robot"),
            (0.5 * (stay.start_s + stay.end_s) / 3600.0, lanes[dock] - 0.24),
            ha="center",
            va="bottom",
            fontsize=6,
        )
    for place, stay in enumerate(deaths_of(record, end_s)):
        _bar(axes, lanes, stay.agent, stay, "white", label="" if place else "dead", hatch="xxxx", edge=_INK)
    axes.set_yticks(list(lanes.values()), list(lanes))
    axes.invert_yaxis()
    axes.axhline(len(robots) - 0.5, color=_INK, lw=0.6)
    axes.legend(ncols=6, loc="lower center", bbox_to_anchor=(0.5, -0.12), frameon=False, fontsize=7)


def _bar(
    axes: Axes,
    lanes: Mapping[str, float],
    lane: str,
    stay: Holder,
    colour: str,
    label: str = "",
    height: float = 0.76,
    hatch: str = "",
    edge: str = "none",
) -> None:
    if lane in lanes:
        axes.barh(
            lanes[lane],
            (stay.end_s - stay.start_s) / 3600.0,
            left=stay.start_s / 3600.0,
            height=height,
            color=colour,
            edgecolor=edge,
            lw=0.4,
            hatch=hatch or None,
            label=label or None,
        )


def _level(axes: Axes, path: Sequence[Row], empty_v: float, full_v: float) -> None:
    rows = [row for row in path[::EVERY] if row.battery_v is not None]
    times_h = [row.t_s / 3600.0 for row in rows]
    # In one colour: the colours above are those of tasks.
    axes.plot(
        times_h,
        [((row.battery_v or 0.0) - empty_v) / (full_v - empty_v) for row in rows],
        lw=0.7,
        color=_INK,
        alpha=0.6,
    )
