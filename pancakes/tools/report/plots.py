"""Draw the plots of a report: of the mission, and of the agents' performance, in the style of a paper's columns.

Colour-blind people can tell the colours apart. `matplotlib` is imported only when something is drawn. A plot function
returns None if there is nothing to show.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.tools.report.command_latency import Reaction
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.mission import LOST, Body, CommandSpan, TaskLane, TaskMove
from pancakes.tools.report.performance import Flow, TimerRates
from pancakes.tools.report.time_series import Counts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31", "#7f7f7f")
"""The colours of Okabe and Ito without yellow, which is hard to see on white, and two more."""
DASHES: Final = ((0, ()), (0, (4, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))
MARKERS: Final = ("^", "s", "D", "v", "o", "P", "X", "*")
INK, FAINT = "#333333", "#9a9a9a"
COLUMN_IN: Final = 3.5
"""The width of a column of a paper, in inches."""
WIDE_IN: Final = 7.16
DPI: Final = 300
ON_SCREEN: Final = 1.9
"""Pixels on the page per point of a picture: people read a screen from further away than paper."""


@dataclass(frozen=True)
class Picture:
    """A drawn picture.

    Attributes:
        name: the name of its files.
        caption: what it shows.
        svg: the picture as SVG for a page: its ink has the colour of the text around it.
    """

    name: str
    caption: str
    svg: str


class Palette:
    """Give each name one colour and one marker throughout a report.

    Args:
        names: the names; the first ones get the colours that are easiest to tell apart.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._places = {name: place for place, name in enumerate(dict.fromkeys(names))}

    def colour(self, name: str) -> str:
        """Return the colour of a name."""
        return COLOURS[self._place(name) % len(COLOURS)]

    def marker(self, name: str) -> str:
        """Return the marker of a name."""
        return MARKERS[self._place(name) % len(MARKERS)]

    def _place(self, name: str) -> int:
        return self._places.setdefault(name, len(self._places))


@contextmanager
def figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a figure in the report's style; draw and save it inside the context."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    style = resources.files("pancakes.tools.report").joinpath("static/report.mplstyle")
    with resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        made = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(made)
        yield made


def save(made: Figure, out: Path, name: str, caption: str) -> Picture:
    """Write a figure as PNG and SVG, and return it for the page.

    Raises:
        OSError: the files cannot be written.
    """
    import matplotlib

    made.savefig(out / f"{name}.png", dpi=DPI)
    buffer = io.StringIO()
    # The same recording gives the same bytes, so no date and no random ids.
    with matplotlib.rc_context({"svg.hashsalt": name}):
        made.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    svg = buffer.getvalue()
    (out / f"{name}.svg").write_text(svg, encoding="utf-8")
    return Picture(name, caption, _for_page(svg, name))


def _for_page(svg: str, name: str) -> str:
    """Prepare an SVG for a page with others: its ids become unique, its ink takes the colour of the text."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' width="([\d.]+)pt" height="[\d.]+pt"', _as_wide_as_room, svg, count=1)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="(figure|axes|patch|line2d|matplotlib\.axis|[xy]tick|text|legend|\w+Collection)_\d+"', "", svg)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', svg)
    svg = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", svg)
    return svg.replace(INK, "currentColor")


def _as_wide_as_room(size: re.Match[str]) -> str:
    broad = ' class="broad"' if float(size[1]) > 72 * (COLUMN_IN + WIDE_IN) / 2 else ""
    return f'{broad} style="max-width: {float(size[1]) * ON_SCREEN:.0f}px"'


def time_axis(axes: Axes, findings: Findings) -> None:
    """Show the recording's time on the horizontal axis."""
    axes.set_xlim(findings.begin_s, max(findings.end_s, findings.begin_s + 1e-3))
    axes.set_xlabel(f"{findings.time.name} [s]")


def plot_line(axes: Axes, points: Sequence[tuple[Any, ...]], number: int, colour: str, label: str, **how: Any) -> None:
    """Draw a line through points; `number`, its number among the lines of its colour, chooses the dashes."""
    dashes = DASHES[number % len(DASHES)]
    axes.plot([x for x, _ in points], [y for _, y in points], ls=dashes, color=colour, label=label, **how)


def label_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Name the rows of a picture, from the top downwards."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def label_log(axis: Axis) -> None:
    """Write plain numbers along a logarithmic axis. Call it after everything on the axis has been drawn."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    low, high = axis.get_view_interval()
    if high < 30 * low:  # at most one power of ten, so label other digits too
        digits = "234568" if high < 5 * low else "25"
        axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in digits else ""))
    else:
        axis.set_minor_formatter(NullFormatter())


def unit_of_bytes(largest: float) -> tuple[float, str]:
    """Return the divisor for bytes per second that makes figures short, and its unit."""
    for factor, unit in ((1e6, "MB/s"), (1e3, "kB/s")):
        if largest >= factor:
            return factor, unit
    return 1.0, "B/s"


MOST_LANES = 40
MOST_DOTS = 600
MOST_NAMES = 9
MOST_MOVES = 12


def draw_paths(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw the paths of all bodies, and which task drove them. None if there are no positions."""
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
        source = _path_source(findings, tasks)
        return save(made, out, "paths", f"Paths, {source}. Crosses: starts; markers: ends.")


def _path_source(findings: Findings, tasks: Sequence[str]) -> str:
    text = "as estimated by the agents"
    if findings.paths.truth:
        text = "from the simulated world"
        if findings.paths.poses:
            text += "; dots: the robots' own estimates of their poses"
    return f"{text}; line styles: the task that commanded the wheels" if tasks else text


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


def draw_timeline(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw which agent ran which task. None if no task of a mission ran."""
    lanes = [lane for _, lane in sorted(findings.timeline.lanes.items()) if lane.spans][:MOST_LANES]
    if not lanes:
        return None
    shortest_s = 0.002 * findings.duration_s
    with figure(WIDE_IN, 0.2 * len(lanes) + 0.65) as made:
        axes = made.add_subplot()
        for place, lane in enumerate(lanes):
            bars = [(span.from_s, max(span.to_s - span.from_s, shortest_s)) for span in lane.spans]
            axes.broken_barh(bars, (place - 0.36, 0.72), color=palette.colour(lane.agent), lw=0)
            for span in lane.spans:
                if span.ended in ("failed", "given up", LOST):
                    axes.plot(span.to_s, place, "x", ms=5, mew=1.2, color=INK, zorder=3)
                if span.ended == LOST:
                    _say_lost(axes, lane.agent, span.to_s, place, findings)
        for move in findings.moves.moves:
            _arrow(axes, move, lanes)
        label_rows(axes, [f"{lane.agent}  {lane.task}" for lane in lanes])
        time_axis(axes, findings)
        lost = ", and agents that were lost" if findings.losses.losses else ""
        moved = " Arrows: migrations." if any(move.ledger.outcome == "moved" for move in findings.moves.moves) else ""
        return save(made, out, "tasks", f"Which agent ran which task. Crosses: failures{lost}.{moved}")


def _say_lost(axes: Axes, agent: str, at_s: float, place: int, findings: Findings) -> None:
    """Write beside a cross that an agent was lost, on the side with more room."""
    left = at_s > findings.begin_s + findings.duration_s / 2
    how: dict[str, Any] = {"xytext": (-5 if left else 5, 0), "textcoords": "offset points", "zorder": 3}
    box = {"boxstyle": "round,pad=0.1", "fc": "#ffffff", "ec": "none", "alpha": 0.8}
    side = "right" if left else "left"
    axes.annotate(f"{agent} was lost", (at_s, place), va="center", ha=side, fontsize=7, color=INK, bbox=box, **how)


def _arrow(axes: Axes, move: TaskMove, lanes: Sequence[TaskLane]) -> None:
    places = {(lane.agent, lane.task): place for place, lane in enumerate(lanes)}
    begin, end = places.get((move.ledger.source, move.task)), places.get((move.ledger.winner, move.task))
    if move.ledger.outcome == "moved" and begin is not None and end is not None:
        axes.annotate(
            "",
            xy=(move.at_s, end - (0.3 if end > begin else -0.3)),
            xytext=(move.at_s, begin),
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.8, "mutation_scale": 7},
            zorder=4,
        )


def draw_batteries(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw the levels of the batteries. None if no agent has one."""
    batteries = findings.paths.batteries
    if not batteries:
        return None
    with figure(COLUMN_IN, 1.9) as made:
        axes = made.add_subplot()
        for number, (agent, series) in enumerate(sorted(batteries.items())):
            points = [(t_s, 100.0 * level) for t_s, level in series.whole()]
            plot_line(axes, points, number // len(COLOURS), palette.colour(agent), agent, lw=1.1)
        for move in findings.moves.moves[:MOST_MOVES]:
            if move.ledger.outcome == "moved":
                axes.axvline(move.at_s, color=FAINT, lw=0.7, zorder=0)
        axes.set_ylabel("battery [%]")
        axes.margins(y=0.08)
        time_axis(axes, findings)
        made.legend(loc="outside upper center", ncols=min(4, len(batteries)), handlelength=1.6)
        return save(made, out, "batteries", "Battery levels. Vertical lines: migrations.")


def draw_moves(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw the costs that the neighbours bid for each migration. None if no neighbour was asked."""
    moves = [move for move in findings.moves.moves if any(it.cost is not None for it in move.ledger.lines)][:MOST_MOVES]
    if not moves:
        return None
    rows = [(move, it) for move in moves for it in move.ledger.lines]
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
        axes.set_xlabel("cost of the bid")
        return save(made, out, "moves", "The neighbours' bids for each migration. Filled: the agent that got the task.")


MOST_ROWS = 40
MOST_LINES = 7
MOST_SHAPES = 4
NEGLIGIBLE_S = 1e-9
"""Lateness below this is rounding: in virtual time no tick is late."""


def draw_rates(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw the requested and achieved rates. None if no figures were recorded."""
    rows = [
        (timer, shown)
        for _, timer in sorted(findings.rates.timers.items())
        if not timer.task.startswith(("log/", "network/"))
        and (shown := [(at.asked_hz, at.achieved_hz) for at in timer.at if at.achieved_hz is not None])
    ][:MOST_ROWS]
    if not rows:
        return None
    with figure(COLUMN_IN, 0.165 * len(rows) + 0.85) as made:
        axes = made.add_subplot()
        for place, (timer, shown) in enumerate(rows):
            colour = palette.colour(timer.agent)
            for number, (asked_hz, achieved_hz) in enumerate(shown):
                first = not place and not number
                got_hz = max(achieved_hz, 1e-3)
                axes.plot([asked_hz, got_hz], [place, place], lw=0.8, color=FAINT, zorder=1)
                label = "requested" if first else ""
                axes.plot(asked_hz, place, "o", ms=5.5, mfc="none", mec=INK, mew=0.8, label=label)
                axes.plot(got_hz, place, "o", ms=3, color=colour, label="achieved" if first else "")
        label_rows(axes, [_timer_name(findings, timer) for timer, _ in rows])
        axes.grid(axis="y", lw=0.3, color=FAINT, alpha=0.5)
        axes.set_xscale("log")
        label_log(axes.xaxis)
        axes.set_xlabel("rate [Hz of mission time]")
        made.legend(loc="outside upper center", ncols=2)
        return save(made, out, "rates", "Rates of time-driven tasks: requested and achieved.")


def _timer_name(findings: Findings, timer: TimerRates) -> str:
    return f"{timer.agent} {findings.rates.name(timer).rpartition('/')[2]}"


def draw_lateness(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw how late ticks were. None if no tick was late, or no figures were recorded."""
    timers = [timer for _, timer in sorted(findings.rates.timers.items()) if timer.ticks]
    late = sorted((timer for timer in timers if timer.lateness_max_s > NEGLIGIBLE_S), key=lambda it: -it.lateness_max_s)
    if not late:
        return None
    shown = late[:20]
    with figure(WIDE_IN, max(1.9, 0.165 * len(shown) + 0.7)) as made:
        left, right = made.subplots(1, 2, width_ratios=(1.0, 1.15))
        for place, timer in enumerate(shown):
            colour = palette.colour(timer.agent)
            usual_s = timer.lateness_quantile_s(0.5)
            usual_ms = 1e3 * max(timer.lateness_mean_s if usual_s is None else usual_s, 1e-6)
            rare_ms, max_ms = 1e3 * (timer.lateness_quantile_s(0.99) or 0.0), 1e3 * timer.lateness_max_s
            left.plot([usual_ms, max_ms], [place, place], lw=1.0, color=colour)
            left.plot(usual_ms, place, "o", ms=3.5, color=colour)
            left.plot(max_ms, place, "|", ms=6, mew=1.2, color=colour)
            if rare_ms > usual_ms:
                left.plot(rare_ms, place, "D", ms=2.6, color=colour)
        label_rows(left, [_timer_name(findings, timer) for timer in shown])
        left.set_xscale("log")
        label_log(left.xaxis)
        counted = any(timer.lateness_counts for timer in shown)
        left.set_xlabel("lateness [ms]: p50, p99, and largest" if counted else "lateness [ms]: mean, and largest")
        for timer in shown[:MOST_LINES]:
            points = [(t_s, 1e3 * max(mean_s, 1e-6)) for t_s, mean_s in timer.lateness.whole()]
            number = [other for other in shown if other.agent == timer.agent].index(timer)
            plot_line(right, points, number, palette.colour(timer.agent), _timer_name(findings, timer), lw=0.8)
        right.set_yscale("log")
        label_log(right.yaxis)
        right.set_ylabel("mean lateness [ms]")
        time_axis(right, findings)
        made.legend(loc="outside upper right", ncols=3, handlelength=1.8)
        return save(made, out, "lateness", "Lateness of ticks. Right: the mean of each second, for the latest tasks.")


def draw_drops(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draw the packets that were dropped from mailboxes. None if none were."""
    drops = sorted((it for it in findings.rates.drops.values() if it.total), key=lambda it: -it.total)[:MOST_LINES]
    if not drops:
        return None
    from matplotlib.ticker import MaxNLocator

    with figure(COLUMN_IN, 1.9) as made:
        axes = made.add_subplot()
        for number, it in enumerate(drops):
            label = f"{it.agent} {it.task.rpartition('/')[2]}"
            colour = palette.colour(it.agent)
            plot_line(axes, it.over_time.whole(), number, colour, label, lw=1.0, drawstyle="steps-post")
        axes.set_ylabel("packets dropped")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        time_axis(axes, findings)
        made.legend(loc="outside upper center", ncols=2, handlelength=1.8)
        return save(made, out, "drops", "Packets dropped from mailboxes so far, because their readers were slow.")


def draw_traffic(findings: Findings, out: Path, name: str, flow: Flow, of: str) -> Picture | None:
    """Draw packets and bytes over time. None if nothing travelled.

    Args:
        findings: gives the time axis.
        out: the folder.
        name: the name of the files.
        flow: the traffic.
        of: what its kinds are called, such as `link`.
    """
    names = flow.names()
    if not names:
        return None
    begin_s, length_s = findings.begin_s, findings.duration_s
    shown, others = names[:MOST_LINES], names[MOST_LINES:]
    with figure(WIDE_IN, 2.3) as made:
        left, right = made.subplots(1, 2)
        sizes = [rate for kind in shown for _, rate in flow.bytes.rates(kind, length_s)]
        factor, unit = unit_of_bytes(max(sizes, default=0.0))
        for number, kind in enumerate(shown):
            _line(left, flow.packets, kind, (begin_s, length_s), 1.0, number)
            _line(right, flow.bytes, kind, (begin_s, length_s), factor, number)
        left.set_ylabel("packets/s")
        right.set_ylabel(unit)
        for axes in (left, right):
            axes.set_ylim(bottom=0.0)
            time_axis(axes, findings)
        handles, labels = left.get_legend_handles_labels()
        made.legend(handles, labels, loc="outside upper center", ncols=4, handlelength=1.8)
        less = f"; {len(others)} with less traffic are left out" if others else ""
        return save(made, out, name, f"Packets and bytes between agents, by {of}{less}.")


def _line(axes: Axes, counts: Counts, kind: str, span_s: tuple[float, float], factor: float, number: int) -> None:
    begin_s, length_s = span_s
    points = [(begin_s + t_s, rate / factor) for t_s, rate in counts.rates(kind, length_s)]
    plot_line(axes, points, number, COLOURS[number % len(COLOURS)], kind, lw=0.9)


def draw_reactions(findings: Findings, out: Path) -> Picture | None:
    """Draw the most frequent chains that led to commands. None if no command has a known cause."""
    reactions = findings.reactions.reactions()[:MOST_SHAPES]
    if not reactions:
        return None
    heights = [0.2 * len(it.steps) + 0.62 for it in reactions]
    with figure(WIDE_IN, sum(heights) + 0.25) as made:
        grid = made.subplots(len(reactions), 2, squeeze=False, height_ratios=heights, width_ratios=(1.6, 1.0))
        for (steps, times), it in zip(grid, reactions, strict=True):
            _steps(steps, it)
            _times(times, it)
        grid[-1][0].set_xlabel("mean time since the first cause [ms]")
        grid[-1][1].set_xlabel("time from cause to command [ms]")
        return save(
            made,
            out,
            "reactions",
            "From the first cause to the actuator's command, by kind of chain. Left: the mean time of each step;"
            " hatched: on the way between agents. Right: the whole time.",
        )


def _steps(axes: Axes, it: Reaction) -> None:
    at_ms = 0.0
    means = it.step_means_s
    for place, took_s in enumerate(means):
        travel_ms, rest_ms = 1e3 * it.travel_means_s[place], 1e3 * (took_s - it.travel_means_s[place])
        axes.barh(place, travel_ms, 0.6, left=at_ms, color="none", ec=COLOURS[0], hatch="/////", lw=0.6)
        axes.barh(place, rest_ms, 0.6, left=at_ms + travel_ms, color=COLOURS[0], lw=0)
        at_ms += 1e3 * took_s
    axes.plot(at_ms, len(means), "D", ms=4, color=COLOURS[1])
    label_rows(axes, [_step_name(step) for step in it.steps])
    axes.set_xlim(0.0, 1.04 * at_ms if at_ms > 0 else 1.0)
    axes.set_title(f"{it.count:,} times", loc="left", pad=3)


def _step_name(step: str) -> str:
    source, _, kind = step.rpartition(" ")
    agent, _, rest = source.partition("/")
    return f"{agent} {rest.rpartition('/')[2]}: {kind}"


def _times(axes: Axes, it: Reaction) -> None:
    values = sorted(1e3 * value for value in it.latency_s.kept)
    low, high = values[0], values[min(len(values) - 1, int(0.995 * len(values)))]
    # If all values are equal, as in virtual time, the bar still needs some width.
    margin = max(0.05 * (high - low), 0.02 * high, 1e-3)
    bounds = (max(0.0, low - margin), high + margin)
    axes.hist(values, bins=40, range=bounds, color=COLOURS[0], lw=0)
    shares = it.latency_s.quantiles()
    for number, seconds in enumerate(shares.values()):
        axes.axvline(1e3 * seconds, color=COLOURS[1], lw=0.9, ls=DASHES[number])
    text = ", ".join(f"{name} {1e3 * seconds:.3g}" for name, seconds in shares.items())
    axes.set_title(f"{text} ms", loc="left", pad=3)
    axes.set_xlim(*bounds)
    axes.set_ylabel("chains")
