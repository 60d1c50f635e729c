"""Make the page of a report: a summary first, then figures, with tables and details folded away."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Final

from pancakes.tools.report.command_latency import Reaction
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.mission import DigestEntry, TaskMove
from pancakes.tools.report.performance import Rates, TimerRates, is_terminal
from pancakes.tools.report.picker import picker_html, static_text
from pancakes.tools.report.plots import COLOURS, Picture
from pancakes.tools.report.summary import MOVED, Summary, Verdict, pause_s, worst_entries

MOST_ROWS: Final = 200
"""The most rows of a table; the rest is in report.json, or left out."""
FEW: Final = 8
"""The most rows that are shown before a reader unfolds the rest."""
ON_TIME: Final = 0.95
"""A timer that achieves this share of its rate is as fast as it should be."""


def make_page(
    title: str,
    about: Mapping[str, str],
    notes: Sequence[str],
    findings: Findings,
    pictures: Mapping[str, Picture],
    verdict: Verdict | None = None,
) -> str:
    """Return the page.

    Args:
        title: the title of the page.
        about: facts about the whole recording.
        notes: sentences about what the recording lacks.
        findings: what the recording shows.
        pictures: the pictures that were drawn, by name.
        verdict: what a demo said of its mission; None: nothing.
    """
    sections = [
        ("mission", "Mission", _mission(findings, pictures)),
        ("performance", "Performance", _performance(findings, pictures)),
        ("traffic", "Traffic", _traffic(findings, pictures)),
        ("reactions", "Cause and effect", _reactions(findings, pictures)),
        ("log", "Log", _event_digest(findings)),
    ]
    facts = " · ".join(f"{escape(key)}: {escape(value)}" for key, value in about.items())
    noted = "".join(f'<p class="note">{escape(note)}</p>' for note in notes)
    body = "".join(
        f'<section id="{key}"><h2>{escape(name)}</h2>{html}</section>' for key, name, html in sections if html
    )
    lacks = _lacks(findings, pictures)
    style = static_text("report.css") + static_text("picker.css")
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>"
        f'<header><h1>{escape(title)}</h1><p class="faint">{facts}</p></header>{noted}'
        f'<section id="summary" aria-label="Summary">{_summary(Summary.of(findings, verdict))}</section>'
        f"<main>{body}{lacks}</main></body></html>\n"
    )


# The summary -----------------------------------------------------------------------------------------------------


def _summary(it: Summary) -> str:
    """Return a figure for each thing that a reader wants to know first; each leads to its section."""
    tiles = []
    if it.verdict is not None:
        reasons = "; ".join(it.verdict.reasons) or "as the demo judged its mission"
        tiles.append(_tile("verdict", it.verdict.word, reasons, "#mission", "good" if it.verdict.passed else "bad"))
    tiles.append(_tile("duration", _duration(it.duration_s), f"of {_counted(it.agents, 'agent')}", "#mission"))
    pause = f"paused for {_seconds(it.longest_pause_s)} at most" if it.longest_pause_s is not None else ""
    stayed = f"{it.stayed} came to nothing" if it.stayed else ""
    taken = f"{_counted(it.taken_over, 'task')} taken over" if it.taken_over else ""
    text = "; ".join(part for part in (stayed, taken, pause) if part) or (
        "no pause was recorded" if it.moved else "none took place"
    )
    tiles.append(_tile("migrations", f"{it.moved}", text, "#mission", "bad" if it.stayed else ""))
    tiles.append(_lateness_tile(it))
    warned = _counted(it.warnings, "warning") if it.warnings else "no warnings"
    if it.lost_agents:
        warned = f"{' and '.join(it.lost_agents)} {'was' if len(it.lost_agents) == 1 else 'were'} lost; {warned}"
    state = "bad" if it.errors else "fair" if it.warnings else "good"
    tiles.append(_tile("errors", f"{it.errors}", warned, "#log", state))
    if it.measured:
        lost = "dropped, or their handlers failed" if it.lost else "none was dropped"
        tiles.append(_tile("packets lost", f"{it.lost:,}", lost, "#performance", "bad" if it.lost else "good"))
    else:
        tiles.append(_tile("packets lost", "unknown", "no figures of tasks were recorded", "#lacks"))
    return f"<ul>{''.join(tiles)}</ul>"


def _lateness_tile(it: Summary) -> str:
    missed = f"; {_counted(it.missed, 'tick')} missed" if it.missed else ""
    if not it.measured:
        return _tile("worst lateness", "unknown", "no figures of tasks were recorded", "#lacks")
    if it.worst is None:
        return _tile("worst lateness", "none", f"no tick was late{missed}", "#performance", "good")
    whose = f"{it.worst.agent} {it.worst.name}{missed}"
    return _tile("worst lateness", _seconds(it.worst.lateness_s), whose, "#performance", "bad" if it.missed else "")


def _tile(name: str, value: str, text: str, link: str, state: str = "") -> str:
    kind = f' class="{state}"' if state else ""
    return (
        f'<li{kind}><a href="{link}"><span>{escape(name)}</span> <b>{escape(value)}</b> <small>{escape(text)}</small>'
        "</a></li>"
    )


def _counted(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02} s" if minutes else f"{seconds:.3g} s"


# Parts of sections ----------------------------------------------------------------------------------------------


def _figure(pictures: Mapping[str, Picture], *names: str) -> str:
    """Return those of the pictures that were drawn, side by side where there is room."""
    found = [pictures[name] for name in names if name in pictures]
    return f'<div class="figures">{"".join(map(_drawn, found))}</div>' if found else ""


def _drawn(picture: Picture) -> str:
    caption = escape(picture.caption)
    svg = picture.svg.replace("<svg", f'<svg role="img" aria-label="{caption}"', 1)
    wide = ' class="whole"' if 'class="broad"' in picture.svg else ""
    return f"<figure{wide}>{_wide(_in_colours_of_the_page(svg))}<figcaption>{caption}</figcaption></figure>"


def _in_colours_of_the_page(svg: str) -> str:
    """Replace the colours of the pictures by variables of the page, which differ in dark mode."""
    for place, colour in enumerate(COLOURS):
        svg = svg.replace(colour, f"var(--c{place})")
    return svg.replace("#9a9a9a", "var(--grey)").replace("#ffffff", "var(--paper)")


def _faint(text: str) -> str:
    return f'<p class="faint">{escape(text)}</p>'


def _folded(title: str, html: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{html}</details>" if html else ""


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; numbers are aligned to the right, unknown values are empty."""
    kept = list(rows)
    if not kept:
        return ""
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
        if abs(value) >= 1000:
            return f"{value:,.0f}"
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _seconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if abs(seconds) < 1.0 else f"{seconds:.3g} s"


def _lacks(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    """Return what a reader may miss, in one section at the end."""
    missing = [
        ("paths", "The recording has no positions."),
        ("tasks", "The recording has no task of a mission."),
        ("batteries", "The recording has no battery."),
        ("traffic-links", "The recording has no packets between agents."),
    ]
    found = [text for name, text in missing if name not in pictures]
    if not findings.rates.samples:
        found.append(_NO_FIGURES)
    if not findings.reactions.commands:
        found.append("No actuator was commanded.")
    items = "".join(f"<li>{escape(text)}</li>" for text in found)
    return (
        f'<section id="lacks"><h2>Not in this recording</h2><ul class="faint">{items}</ul></section>' if found else ""
    )


_NO_FIGURES: Final = (
    "The recording has no figures of tasks. A recorder samples them if it records all channels, or the channel named"
    " recording."
)


# Sections --------------------------------------------------------------------------------------------------------


def _mission(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    return _figure(pictures, "tasks", "paths", "batteries") + _moves(findings, pictures)


def _moves(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    moves = findings.moves.moves
    if not moves:
        return ""
    rows = [
        (
            round(move.at_s, 2),
            move.ledger.task_id,
            f"{move.ledger.source} → {move.ledger.winner}" if move.ledger.outcome == MOVED else move.ledger.source,
            move.outcome,
            *(_seconds(it) if it is not None else "" for it in (pause_s(move), move.silence_s)),
        )
        for move in moves
    ]
    head = ("time [s]", "task", "from → to", "outcome", "paused", "published nothing")
    details = _figure(pictures, "moves") + "".join(_move(move) for move in moves)
    left = _faint(f"{findings.moves.left_out} more are left out.") if findings.moves.left_out else ""
    return (
        "<h3>Migrations</h3>"
        + _first_rows(head, rows, "migrations")
        + left
        + _folded("Who was asked, and what each answered", details)
    )


def _move(move: TaskMove) -> str:
    ledger = move.ledger
    to = f" to {ledger.winner}" if ledger.winner else ""
    asker = {"rule": "a rule of its own", "guardians": "its guardians"}.get(ledger.asked_by, ledger.asked_by)
    only = f"Only {ledger.to} was asked. " if ledger.to else ""
    text = f"Asked for by {asker}; cost: {ledger.cost}. {only}It took {_seconds(ledger.duration_s)} of host time."
    rows = [(it.peer, it.answer, it.cost, it.fate, it.reason) for it in ledger.lines]
    asked = _table(("asked", "answer", "cost", "fate", "reason"), rows) or _faint("No neighbour was asked.")
    head = f"{ledger.task_id} at {move.at_s:.1f} s: {move.outcome} from {ledger.source}{to}"
    if ledger.outcome != MOVED:
        head = f"{ledger.task_id} at {move.at_s:.1f} s: {ledger.outcome}{f', best: {ledger.winner}' if to else ''}"
    return f"<h4>{escape(head)}</h4><p>{escape(text)}</p>{asked}"


def _first_rows(head: Sequence[str], rows: Sequence[Sequence[Any]], what: str) -> str:
    """Return a table with the first rows, and the others folded away."""
    rest = rows[FEW:]
    return _table(head, rows[:FEW]) + _folded(f"{len(rest)} more {what}", _table(head, rest))


def _performance(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    if not findings.rates.samples:
        return ""
    timers = [timer for _, timer in sorted(findings.rates.timers.items())]
    html = f"<p>{escape(_rates_in_words(timers, findings.rates))}</p>"
    html += _figure(pictures, "lateness")
    if "lateness" in pictures:
        html += _faint(
            "In mission time. The largest counts from the start of the task, even before the recording began."
        )
    html += _folded("Rates: requested and achieved", _figure(pictures, "rates") + _rates(timers))
    if "lateness" in pictures:
        html += _folded("Lateness of each timer", _lateness(timers))
    return html + _lost(findings, pictures)


def _rates_in_words(timers: Sequence[TimerRates], rates: Rates) -> str:
    """Return in a sentence whether timers achieve their rates, and which is worst."""
    shares = [
        (at.achieved_hz / at.asked_hz, timer, at.asked_hz, at.achieved_hz)
        for timer in timers
        for at in timer.at
        if at.achieved_hz is not None and at.asked_hz > 0
    ]
    if not shares:
        return "No time-driven task ran for long enough to measure its rate."
    _, timer, asked_hz, achieved_hz = min(shares, key=lambda it: it[0])
    worst = f"{timer.agent} {rates.name(timer)} ({achieved_hz:.3g} of {asked_hz:.3g} Hz)"
    slow = len({id(timer) for share, timer, *_ in shares if share < ON_TIME})
    if not slow:
        return f"All {_counted(len(timers), 'timer')} achieve their rates; the slowest is {worst}."
    return (
        f"{slow} of {_counted(len(timers), 'timer')} achieve less than {ON_TIME:.0%} of their rates; worst is {worst}."
    )


def _rates(timers: Sequence[TimerRates]) -> str:
    rows = [
        (timer.agent, timer.task, timer.timer, at.asked_hz, at.achieved_hz, at.during_s)
        for timer in timers
        for at in timer.at
    ]
    return _table(("agent", "task", "timer", "requested [Hz]", "achieved [Hz]", "for [s]"), rows)


def _lateness(timers: Sequence[TimerRates]) -> str:
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
        for timer in sorted(timers, key=lambda it: -it.lateness_max_s)
    ]
    head = ("agent", "task", "timer", "ticks", "missed", "mean [ms]", "p50 [ms]", "p99 [ms]", "largest [ms]")
    return _table(head, rows)


def _in_ms(seconds: float | None) -> float | None:
    return 1e3 * seconds if seconds is not None else None


def _lost(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    """Return which packets were lost, if any were."""
    rates = findings.rates
    mailboxes = sorted(
        ((it.agent, it.task, it.total) for it in rates.drops.values() if it.total), key=lambda row: -row[2]
    )
    links = [(agent, peer, link.dropped) for (agent, peer), link in rates.links.items() if link.dropped]
    odd = [
        (agent, rates.undelivered[agent], rates.dead_letters[agent])
        for agent in sorted(rates.undelivered)
        if rates.undelivered[agent] or rates.dead_letters[agent]
    ]
    return (
        _folded(
            "Packets dropped from mailboxes",
            _figure(pictures, "drops") + _table(("agent", "task", "packets"), mailboxes),
        )
        + _folded("Packets dropped on links with a slow receiver", _table(("from", "to", "packets"), links))
        + _folded("Packets that nobody handled", _table(("agent", "no subscriber", "handler failed"), odd))
    )


def _traffic(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    traffic = findings.traffic
    html = ""
    if "traffic-links" in pictures:
        counted = {
            name: [(it, int(flow.packets.total(it)), int(flow.bytes.total(it))) for it in flow.names()]
            for name, flow in (("link", traffic.links), ("channel", traffic.channels))
        }
        packets, size = sum(count for _, count, _ in counted["link"]), sum(size for *_, size in counted["link"])
        busiest = counted["link"][0][0]
        html = f"<p>{packets:,} packets between agents, {_bytes(size)}; most of them {escape(busiest)}.</p>"
        tables = "".join(_table((name, "packets", "bytes"), rows) for name, rows in counted.items())
        note = "Recorded packets with their size on the wire, without the messages of the links themselves."
        if traffic.terminals:
            note += f" {_counted(traffic.terminals, 'packet')} from and to terminals are left out."
        html += _folded(
            "By link and by channel", _figure(pictures, "traffic-links", "traffic-channels") + tables + _faint(note)
        )
    links = [
        (agent, peer, _in_ms(link.rtt_s), link.packets_out, link.bytes_out, link.packets_in, link.bytes_in)
        for (agent, peer), link in sorted(findings.rates.links.items())
        if not is_terminal(peer)
    ]
    head = ("agent", "link to", "round trip [ms]", "packets out", "bytes out", "packets in", "bytes in")
    html += _folded("Links as the agents count them, since they were connected", _table(head, links))
    rows = [(*topic, count) for topic, count in sorted(findings.topics.items())]
    return html + _folded("All recorded packets", _table(("agent", "channel", "type", "packets"), rows))


def _bytes(size: int) -> str:
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= factor:
            return f"{size / factor:.3g} {unit}"
    return _counted(size, "byte")


def _reactions(findings: Findings, pictures: Mapping[str, Picture]) -> str:
    found = findings.reactions
    if not found.commands:
        return ""
    caused = f"{found.uncaused:,} of them answer no packet" if found.uncaused else "each of them answers a packet"
    kinds = found.reactions()
    rows = [
        (
            it.count,
            *(1e3 * value_s for value_s in it.latency_s.quantiles().values()),
            1e3 * it.latency_s.largest,
            _chain(it),
        )
        for it in kinds
    ]
    shares = [f"{name} [ms]" for name in next((it.latency_s.quantiles() for it in kinds), ())]
    table = _first_rows(("times", *shares, "longest [ms]", "from the first cause to the command"), rows, "kinds")
    details = _figure(pictures, "reactions") + "".join(_steps(it) for it in kinds[:12])
    left = len(kinds) - 12
    details += _faint(f"{left} rarer kinds of chains are left out.") if left > 0 else ""
    text = f"{found.commands:,} commands to actuators; {caused} that was recorded."
    return f"<p>{text}</p>{table}{_folded('Step by step', details)}" + (
        f'<details id="any-command"><summary>Any command</summary>{picker_html(found)}</details>'
    )


def _chain(it: Reaction) -> str:
    return " → ".join(it.steps)


def _steps(it: Reaction) -> str:
    means, travels = [*it.step_means_s, None], [*it.travel_means_s, None]
    rows = [
        (step, 1e3 * mean if mean is not None else None, 1e3 * travel if travel is not None else None)
        for step, mean, travel in zip(it.steps, means, travels, strict=True)
    ]
    shares = ", ".join(f"{name} {_seconds(value_s)}" for name, value_s in it.latency_s.quantiles().items())
    head = f"<h4>{it.count:,} times: {shares}, longest {_seconds(it.latency_s.largest)}</h4>"
    return head + _table(("step", "to the next [ms]", "of that between agents [ms]"), rows)


def _event_digest(findings: Findings) -> str:
    digest = findings.events
    first = worst_entries(digest.grave, len(digest.grave))
    html = _log_table(first[:FEW]) if first else _faint("No warning, error or failure was logged.")
    html += _folded(f"{len(first[FEW:])} more warnings", _log_table(first[FEW:]))
    html += _folded("Events of the mission", _log_table(digest.events))
    return html + (_faint(f"{digest.left_out} more are left out.") if digest.left_out else "")


def _log_table(entries: Sequence[DigestEntry]) -> str:
    rows = [(round(it.t_s, 2), it.agent, it.kind, it.text, it.count) for it in entries]
    return _table(("time [s]", "agent", "what", "", "times"), rows)
