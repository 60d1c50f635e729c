"""Make a report of a recording: read it, draw it, and write one self-contained HTML page.

The page works on any screen and on paper. Its picker explains any command; without scripts, the page shows only the
slowest commands.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Final

from pancakes.errors import PancakesError, needing_extra
from pancakes.recording.clock_alignment import speed_of
from pancakes.recording.records import NANOSECONDS, RecordingError, date_of
from pancakes.tools.report.command_latency import PickedCommand, PickedCommands, Reaction, Reactions
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.mission import DigestEntry, TaskMove
from pancakes.tools.report.plots import Palette, Picture


def static_text(name: str) -> str:
    """Return the text of a file in `static`."""
    return resources.files("pancakes.tools.report").joinpath("static", name).read_text(encoding="utf-8")


SLOWEST: Final = 5
"""How many of the slowest commands to each actuator are shown even without scripts."""


def picker_html(found: Reactions) -> str:
    """Return the picker with its data and its script, and tables of the slowest commands."""
    picked = found.picked
    data = picked.plain()
    by_steps = {it.steps: it for it in found.reactions()}
    shapes = (tuple(data["names"][place] for place in kind) for kind in data["kinds"])
    data["distributions"] = [_distribution(by_steps.get(shape)) for shape in shapes]
    # The data must not contain `</script>`.
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    left_out = f" {picked.left_out:,} commands to other actuators are left out." if picked.left_out else ""
    return (
        Template(static_text("picker.html")).substitute(left_out=left_out)
        + _slowest(picked)
        + f'<script type="application/json" id="commands-data">{text}</script>'
        + f"<script>{static_text('picker.js')}</script>"
    )


def _distribution(reaction: Reaction | None) -> dict[str, Any] | None:
    if reaction is None:
        return None
    shares = {name: _ms(value_s) for name, value_s in reaction.latency_s.quantiles().items()}
    return {"count": reaction.count, **shares, "max": _ms(reaction.latency_s.largest)}


def _slowest(picked: PickedCommands) -> str:
    html = ""
    for actuator in picked.actuators():
        rows = "".join(_row(command) for command in actuator.slowest()[:SLOWEST])
        if rows:
            html += (
                f"<details><summary>{escape(actuator.agent)} {escape(actuator.type)}: the slowest of {actuator.count:,}"
                ' commands</summary><div class="wide" tabindex="0"><table><tr><th class="n">mission time [s]</th>'
                f'<th class="n">took</th><th>step by step</th></tr>{rows}</table></div></details>'
            )
    return html


def _row(command: PickedCommand) -> str:
    parts = []
    for step, following in zip(command.steps, (*command.steps[1:], None), strict=True):
        took = f" → {_ms(step.travel_s + step.handling_s)} → " if following is not None else ""
        parts.append(f"{escape(step.name)} #{step.packet.number}{took}")
    took = _ms(command.latency_s)
    return f'<tr><td class="n">{command.mission_s:.3f}</td><td class="n">{took}</td><td>{"".join(parts)}</td></tr>'


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


MOST_ROWS: Final = 200


def make_page(
    title: str, about: Mapping[str, str], notes: Sequence[str], findings: Findings, pictures: Mapping[str, Picture]
) -> str:
    """Return the page.

    Args:
        title: the title of the page.
        about: facts about the whole recording.
        notes: sentences about what the recording lacks.
        findings: what the recording shows.
        pictures: the pictures that were drawn, by name.
    """
    sections = [
        ("paths", "Paths", _shown(pictures, "paths", "The recording has no positions.")),
        ("tasks", "Which agent ran which task", _shown(pictures, "tasks", "The recording has no task of a mission.")),
        ("moves", "Migrations", _moves(findings, pictures)),
        ("batteries", "Batteries", _shown(pictures, "batteries", "The recording has no battery.")),
        ("rates", "Rates", _rates(findings, pictures)),
        ("lateness", "Lateness", _lateness(findings, pictures)),
        ("drops", "Drops", _drops(findings, pictures)),
        ("traffic", "Traffic", _traffic(findings, pictures)),
        ("reactions", "Cause and effect", _reactions(findings, pictures)),
        ("log", "Log", _event_digest(findings)),
    ]
    links = "".join(f'<a href="#{key}">{escape(name)}</a> ' for key, name, _ in sections)
    facts = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in about.items())
    noted = "".join(f'<p class="note">{escape(note)}</p>' for note in notes)
    body = "".join(f'<section id="{key}"><h2>{escape(name)}</h2>{html}</section>' for key, name, html in sections)
    style = static_text("report.css") + static_text("picker.css")
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>"
        f"<header><h1>{escape(title)}</h1><dl>{facts}</dl></header>{noted}<nav>{links}</nav>"
        f"<main>{body}</main></body></html>\n"
    )


def _shown(pictures: Mapping[str, Picture], name: str, otherwise: str) -> str:
    picture = pictures.get(name)
    if picture is None:
        return _faint(otherwise)
    caption = escape(picture.caption)
    svg = picture.svg.replace("<svg", f'<svg role="img" aria-label="{caption}"', 1)
    return f"<figure>{_wide(svg)}<figcaption>{caption}</figcaption></figure>"


def _faint(text: str) -> str:
    return f'<p class="faint">{escape(text)}</p>'


def _folded(title: str, html: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{html}</details>"


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; numbers are aligned to the right, unknown values are empty."""
    kept = list(rows)
    numeric = [any(isinstance(row[place], int | float) for row in kept) for place in range(len(head))]
    cells = [' class="n"' if it else "" for it in numeric]
    html = "".join(f"<th{cell}>{escape(name)}</th>" for name, cell in zip(head, cells, strict=True))
    lines = [
        "<tr>" + "".join(f"<td{c}>{escape(_text(value))}</td>" for value, c in zip(row, cells, strict=True)) + "</tr>"
        for row in kept[:MOST_ROWS]
    ]
    more = _faint(f"{len(kept) - MOST_ROWS} more are left out.") if len(kept) > MOST_ROWS else ""
    return _wide(f"<table><tr>{html}</tr>{''.join(lines)}</table>") + more


def _wide(html: str) -> str:
    """Wrap content that may be wider than the screen, so that it scrolls by finger, wheel and arrow keys."""
    return f'<div class="wide" tabindex="0">{html}</div>'


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _moves(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    moves = findings.moves
    if not moves.moves:
        return _faint("No task was asked to migrate.")
    html = _shown(pictures, "moves", "") if "moves" in pictures else ""
    html += "".join(_move(move) for move in moves.moves)
    return html + (_faint(f"{moves.left_out} more are left out.") if moves.left_out else "")


def _move(move: TaskMove) -> str:
    ledger = move.ledger
    to = f" to {ledger.winner}" if ledger.winner else ""
    asker = {"rule": "a rule of its own", "guardians": "its guardians"}.get(ledger.asked_by, ledger.asked_by)
    only = f"Only {ledger.to} was asked. " if ledger.to else ""
    parts = [f"Asked for by {asker}; cost: {ledger.cost}. {only}It took {_seconds(ledger.duration_s)} of host time."]
    if move.frozen_s is not None and move.started_s is not None:
        parts.append(f"The task was paused for {_seconds(move.started_s - move.frozen_s)} of mission time.")
    if move.silence_s is not None:
        parts.append(
            f"Its last packet from the old agent and its first from the new one are {_seconds(move.silence_s)} of"
            " mission time apart."
        )
    rows = [(it.peer, it.answer, it.cost, it.fate, it.reason) for it in ledger.lines]
    asked = _table(("asked", "answer", "cost", "fate", "reason"), rows) if rows else _faint("No neighbour was asked.")
    head = f"{ledger.task_id} at {move.at_s:.1f} s: {ledger.outcome} from {ledger.source}{to}"
    if ledger.outcome != "moved":
        head = f"{ledger.task_id} at {move.at_s:.1f} s: {ledger.outcome}{f', best: {ledger.winner}' if to else ''}"
    return f"<h3>{escape(head)}</h3><p>{escape(' '.join(parts))}</p>{asked}"


def _seconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if abs(seconds) < 1.0 else f"{seconds:.3g} s"


_NO_FIGURES: Final = (
    "The recording has no figures of tasks. A recorder samples them if it records all channels, or the channel named"
    " recording."
)


def _rates(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    if not findings.rates.samples:
        return _faint(_NO_FIGURES)
    rows = [
        (timer.agent, timer.task, timer.timer, at.asked_hz, at.achieved_hz, at.during_s)
        for _, timer in sorted(findings.rates.timers.items())
        for at in timer.at
    ]
    head = ("agent", "task", "timer", "requested [Hz]", "achieved [Hz]", "for [s]")
    return _shown(pictures, "rates", "No time-driven task ran for long enough.") + _table(head, rows)


def _lateness(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    if not findings.rates.samples:
        return _faint(_NO_FIGURES)
    rows = [
        (
            timer.agent,
            timer.task,
            timer.timer,
            timer.ticks,
            timer.missed,
            1e3 * timer.lateness_mean_s,
            *(_in_ms(timer.lateness_quantile_s(share)) for share in (0.5, 0.99)),
            1e3 * timer.lateness_max_s,
        )
        for _, timer in sorted(findings.rates.timers.items(), key=lambda it: (-it[1].lateness_max_s, it[0]))
    ]
    head = ("agent", "task", "timer", "ticks", "missed", "mean [ms]", "p50 [ms]", "p99 [ms]", "largest [ms]")
    shown = _shown(pictures, "lateness", "No tick was late. In virtual time, ticks are never late.")
    note = _faint("In mission time. The largest counts from the start of the task, even before the recording began.")
    return shown + (_table(head, rows) + note if "lateness" in pictures else "")


def _in_ms(seconds: float | None) -> float | None:
    return 1e3 * seconds if seconds is not None else None


def _drops(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    rates = findings.rates
    if not rates.samples:
        return _faint(_NO_FIGURES)
    rows = [(it.agent, it.task, it.total) for it in rates.drops.values() if it.total]
    html = _shown(pictures, "drops", "No packet was dropped from a mailbox.")
    if rows:
        html += _table(("agent", "task", "packets"), sorted(rows, key=lambda row: -row[2]))
    lost = [(agent, peer, link.dropped) for (agent, peer), link in rates.links.items() if link.dropped]
    if lost:
        html += "<h3>On links with a slow receiver</h3>" + _table(("from", "to", "packets"), lost)
    odd = [
        (agent, rates.undelivered[agent], rates.dead_letters[agent])
        for agent in sorted(rates.undelivered)
        if rates.undelivered[agent] or rates.dead_letters[agent]
    ]
    return html + (_table(("agent", "no subscriber", "handler failed"), odd) if odd else "")


def _traffic(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    traffic = findings.traffic
    html = _shown(pictures, "traffic-links", "The recording has no packets between agents.")
    if "traffic-links" in pictures:
        html += _shown(pictures, "traffic-channels", "")
        for name, flow in (("link", traffic.links), ("channel", traffic.channels)):
            counted = [(it, int(flow.packets.total(it)), int(flow.bytes.total(it))) for it in flow.names()]
            html += _table((name, "packets", "bytes"), counted)
        html += _faint("Recorded packets with their size on the wire, without the messages of the links themselves.")
    if findings.rates.links:
        links = [
            (agent, peer, _in_ms(link.rtt_s), link.packets_out, link.bytes_out, link.packets_in, link.bytes_in)
            for (agent, peer), link in sorted(findings.rates.links.items())
        ]
        head = ("agent", "link to", "round trip [ms]", "packets out", "bytes out", "packets in", "bytes in")
        html += _folded("Links as the agents count them, since they were connected", _table(head, links))
    rows = [(*topic, count) for topic, count in sorted(findings.topics.items())]
    return html + _folded("All recorded packets", _table(("agent", "channel", "type", "packets"), rows))


def _reactions(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    found = findings.reactions
    if not found.commands:
        return _faint("No actuator was commanded.")
    caused = f"{found.uncaused:,} of them answer no packet" if found.uncaused else "each of them answers a packet"
    text = f"{found.commands:,} commands to actuators; {caused} that was recorded."
    html = f"<p>{text}</p>" + _shown(pictures, "reactions", "")
    for it in found.reactions()[:12]:
        means, travels = [*it.step_means_s, None], [*it.travel_means_s, None]
        rows = [
            (step, 1e3 * mean if mean is not None else None, 1e3 * travel if travel is not None else None)
            for step, mean, travel in zip(it.steps, means, travels, strict=True)
        ]
        shares = ", ".join(f"{name} {_seconds(value_s)}" for name, value_s in it.latency_s.quantiles().items())
        html += f"<h3>{it.count:,} times: {shares}, longest {_seconds(it.latency_s.largest)}</h3>"
        html += _table(("step", "to the next [ms]", "of that between agents [ms]"), rows)
    left = len(found.reactions()) - 12
    html += _faint(f"{left} rarer kinds of chains are left out.") if left > 0 else ""
    return html + picker_html(found)


def _event_digest(findings: Findings) -> str:
    digest = findings.events
    html = "<h3>Warnings, errors, failures</h3>" + (_log_table(digest.grave) if digest.grave else _faint("None."))
    if digest.events:
        html += "<h3>Events</h3>" + _log_table(digest.events)
    return html + (_faint(f"{digest.left_out} more are left out.") if digest.left_out else "")


def _log_table(entries: Sequence[DigestEntry]) -> str:
    rows = [(round(it.t_s, 2), it.agent, it.kind, it.text, it.count) for it in entries]
    return _table(("time [s]", "agent", "what", "", "times"), rows)


PAGE: Final = "report.html"
FIGURES: Final = "report.json"


@dataclass(frozen=True)
class Report:
    """The files of a report.

    Attributes:
        page: its page.
        files: all its files with their captions, the page first.
        notes: sentences about what the recording lacks.
    """

    page: Path
    files: tuple[tuple[Path, str], ...]
    notes: tuple[str, ...]


def make_report(path: Path, out: Path, task_id: str = "") -> Report:
    """Make a report.

    Args:
        path: the recording: a file with its parts, or all files of a folder.
        out: the folder for the report; existing files of the same names are replaced.
        task_id: report only on this task, `birthplace/name`; empty: on all.

    Raises:
        PancakesError: the recording or task does not exist, matplotlib or mcap is missing, or the report cannot be
            written.
    """
    with needing_extra("a report cannot be drawn"):
        import matplotlib  # noqa: F401
    with needing_extra("a recording cannot be read"):
        from pancakes.recording.reader import RecordingReader
    reader = RecordingReader(path)
    findings = Findings.of(reader.entries(), task_id, reader.mission_time())
    if not findings.packets:
        raise RecordingError(f"{path} has no packets" + _because(reader.notes()))
    if task_id and not findings.timeline.lanes:
        raise PancakesError(f"{path} has no task {task_id!r}: `pancakes record info` lists its tasks")
    notes = [f"{note}: this report lacks the rest" if "cut off" in note else note for note in reader.notes()]
    if findings.strange:
        notes.append(f"{findings.strange} packets are left out: their types are unknown here, or have changed since")
    virtual = any(reading.about.get("clock") == "mission time" for reading in reader.readings)
    about = {
        "recording": ", ".join(file.name for file in reader.files),
        "agents": ", ".join(findings.agents),
        "began": "in virtual time" if virtual else date_of(findings.first_ns),
        findings.time.name: f"{findings.begin_s:.1f} to {findings.end_s:.1f} s",
        "packets": f"{findings.packets:,}",
    }
    speeds = {speed_of(reading.about) for reading in reader.readings}
    if not virtual and speeds - {1.0}:
        took_s = (findings.last_ns - findings.first_ns) / NANOSECONDS
        many = ", ".join(f"{speed:g}" for speed in sorted(speeds))
        about["took"] = f"{took_s:.1f} s of host time, at {many} mission seconds per second"
    if task_id:
        about["task"] = task_id
    try:
        return _write(path, out, findings, about, notes)
    except OSError as error:
        raise PancakesError(f"the report cannot be written to {out}: {error.strerror or error}") from None


def _write(path: Path, out: Path, findings: Findings, about: dict[str, str], notes: list[str]) -> Report:
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(findings, out)
    title = f"Report on {path.name if path.is_file() else path.resolve().name}"
    page = out / PAGE
    page.write_text(make_page(title, about, notes, findings, {it.name: it for it in pictures}), encoding="utf-8")
    figures = out / FIGURES
    figures.write_text(json.dumps(findings.plain(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    files = [(page, "the report"), (figures, "its figures, for other programs")]
    files += [(out / f"{it.name}{suffix}", it.caption) for it in pictures for suffix in (".png", ".svg")]
    return Report(page, tuple(files), tuple(notes))


def draw_all(findings: Findings, out: Path) -> list[Picture]:
    """Draw the pictures that the findings have data for, and write their files.

    Args:
        findings: what the recording shows.
        out: the folder.

    Raises:
        OSError: the files cannot be written.
    """
    from pancakes.tools.report import plots

    # Robots and agents come first: they get the colours that are easiest to tell apart.
    busy = [*sorted(findings.paths.commands), *sorted(findings.paths.batteries), *findings.agents]
    palette = Palette([*busy, *findings.paths.truth])
    traffic = findings.traffic
    draws: tuple[Callable[[], Picture | None], ...] = (
        lambda: plots.draw_paths(findings, palette, out),
        lambda: plots.draw_timeline(findings, palette, out),
        lambda: plots.draw_moves(findings, palette, out),
        lambda: plots.draw_batteries(findings, palette, out),
        lambda: plots.draw_rates(findings, palette, out),
        lambda: plots.draw_lateness(findings, palette, out),
        lambda: plots.draw_drops(findings, palette, out),
        lambda: plots.draw_traffic(findings, out, "traffic-links", traffic.links, "link"),
        lambda: plots.draw_traffic(findings, out, "traffic-channels", traffic.channels, "channel"),
        lambda: plots.draw_reactions(findings, out),
    )
    return [picture for picture in (draw() for draw in draws) if picture is not None]


def _because(notes: Sequence[str]) -> str:
    text = "; ".join(notes)
    return f": {text}" if text else ""
