"""Pictures of how the agents fared: rates, lateness, drops, traffic, and what led to commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pancakes.tools.report.findings import Findings
from pancakes.tools.report.rate_figures import TimerRates
from pancakes.tools.report.reactions import Reaction
from pancakes.tools.report.series import Counts
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
    label_log,
    label_rows,
    plot_line,
    save,
    time_axis,
    unit_of_bytes,
)
from pancakes.tools.report.traffic import Flow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ROWS = 40
MOST_LINES = 7
MOST_SHAPES = 4
NEGLIGIBLE_S = 1e-9
"""Lateness below this is rounding: in virtual time no tick is late."""


def draw_rates(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws the rates that were asked for and achieved. None where no figures were recorded."""
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
                label = "asked for" if first else ""
                axes.plot(asked_hz, place, "o", ms=5.5, mfc="none", mec=INK, mew=0.8, label=label)
                axes.plot(got_hz, place, "o", ms=3, color=colour, label="achieved" if first else "")
        label_rows(axes, [_timer_name(timer) for timer, _ in rows])
        axes.grid(axis="y", lw=0.3, color=FAINT, alpha=0.5)
        axes.set_xscale("log")
        label_log(axes.xaxis)
        axes.set_xlabel("rate [Hz of mission time]")
        made.legend(loc="outside upper center", ncols=2)
        return save(made, out, "rates", "Rates of time-driven tasks: asked for, and achieved.")


def _timer_name(timer: TimerRates) -> str:
    return f"{timer.agent} {timer.task.rpartition('/')[2]}"


def draw_lateness(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws how late ticks were. None where nothing was, or no figures were recorded."""
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
        label_rows(left, [_timer_name(timer) for timer in shown])
        left.set_xscale("log")
        label_log(left.xaxis)
        counted = any(timer.lateness_counts for timer in shown)
        left.set_xlabel("lateness [ms]: p50, p99, and largest" if counted else "lateness [ms]: mean, and largest")
        for timer in shown[:MOST_LINES]:
            points = [(t_s, 1e3 * max(mean_s, 1e-6)) for t_s, mean_s in timer.lateness.whole()]
            number = [other for other in shown if other.agent == timer.agent].index(timer)
            plot_line(right, points, number, palette.colour(timer.agent), _timer_name(timer), lw=0.8)
        right.set_yscale("log")
        label_log(right.yaxis)
        right.set_ylabel("mean lateness [ms]")
        time_axis(right, findings)
        made.legend(loc="outside upper right", ncols=3, handlelength=1.8)
        return save(
            made, out, "lateness", "How late ticks were; right: the means of a second each, of the latest tasks."
        )


def draw_drops(findings: Findings, palette: Palette, out: Path) -> Picture | None:
    """Draws the packets that fell out of mailboxes. None where none did."""
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
        return save(made, out, "drops", "Packets that fell out of mailboxes because their readers were slow, so far.")


def draw_traffic(findings: Findings, out: Path, name: str, flow: Flow, of: str) -> Picture | None:
    """Draws packets and bytes over time. None where nothing travelled.

    Args:
        findings: from when to when the recording is.
        out: the folder.
        name: of the files.
        flow: what travelled.
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
        less = f"; {len(others)} with less are left out" if others else ""
        return save(made, out, name, f"Packets and bytes between agents, by {of}{less}.")


def _line(axes: Axes, counts: Counts, kind: str, span_s: tuple[float, float], factor: float, number: int) -> None:
    begin_s, length_s = span_s
    points = [(begin_s + t_s, rate / factor) for t_s, rate in counts.rates(kind, length_s)]
    plot_line(axes, points, number, COLOURS[number % len(COLOURS)], kind, lw=0.9)


def draw_reactions(findings: Findings, out: Path) -> Picture | None:
    """Draws the most frequent chains that led to commands. None where none has a cause."""
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
            "From the first cause to the actuator's command, by kind of chain. Left: when each step was taken, on"
            " average; hatched: on the way between agents. Right: how long it took.",
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
    # One value throughout, as in virtual time, still wants a bar of some width.
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
