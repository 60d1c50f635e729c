"""`pancakes rerun`: run a recorded task again with its present code, and show what differs."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.options import Duration, FiniteRange, format_option
from pancakes.tools.cli.output import Part, Printer, Rows, one_line
from pancakes.tools.cli.streaming import load_packets, say
from pancakes.tools.cli.verbs import param_file
from pancakes.tools.cli.verbs.task_arguments import Changes, set_option

if TYPE_CHECKING:
    from pancakes.tools.replay.comparison import Difference, RunComparison, StreamKey
    from pancakes.tools.replay.recorded_run import Script, Stay
    from pancakes.tools.replay.rerun import Outcome

SHOWN: Final = 10
LONGEST: Final = 100
"""At most this many characters of a packet's body are shown in a line."""


@click.command()
@click.argument("path", metavar="FILE|DIR", type=click.Path(path_type=Path))
@click.argument("task", metavar="TASK")
@click.option("--stay", "number", metavar="N", type=click.IntRange(min=1), help="Only the task's Nth stay, from 1.")
@click.option("--agent", metavar="AGENT", default="", help="Only its stays on this agent.")
@set_option("Run it with another setting. Repeatable.")
@click.option(
    "--tolerance",
    metavar="SHARE",
    type=FiniteRange(min=0.0),
    default=1e-6,
    show_default=True,
    help="Numbers count as equal if they differ by at most this share, or from 0 by at most this value.",
)
@click.option(
    "--time-tolerance",
    "time_s",
    metavar="TIME",
    type=Duration(zero=True),
    default="50ms",
    show_default=True,
    help="Compare packets that were published at most this far apart, in mission time.",
)
@click.option(
    "--show", "most", metavar="N", type=click.IntRange(min=0), default=SHOWN, show_default=True,
    help="How many differences of each stay to show.",
)  # fmt: skip
@format_option
def rerun(
    path: Path,
    task: str,
    number: int | None,
    agent: str,
    sets: Changes,
    tolerance: float,
    time_s: float,
    most: int,
    printer: Printer,
) -> None:
    """Run a recorded task again with its present code, and show where its packets differ from the recorded ones.

    TASK is the task's identity, BIRTHPLACE/NAME, or its name if only one task has it. The task runs alone, in virtual
    time: it gets the recorded packets at their times, its timers tick as recorded, and recorded changes of settings are
    made again. Each of its stays on an agent is run separately. The exit code is 0 if all packets that it publishes
    agree with the recording, 1 if not.

    \b
    Example:
        pancakes rerun runs/encirclement-1-virtual/recording ScanTarget
        pancakes rerun recordings agent1/ScanTarget --stay 1 --set radius_m=0.8
    """
    from pancakes.recording.clock_alignment import speed_of
    from pancakes.recording.reader import RecordingReader
    from pancakes.tools.replay.comparison import Tolerance, compare
    from pancakes.tools.replay.recorded_run import choose_stays, find_stays, read_script
    from pancakes.tools.replay.rerun import Rerun, class_of
    from pancakes.util.plugins import Plugins

    plugins = Plugins()
    load_packets(plugins)
    reader = RecordingReader(path)
    stays = find_stays(reader.entries())
    for note in reader.notes():
        say(note)
    about = {reading.about.get("agent", ""): reading.about for reading in reader.readings}
    rows = []
    for stay in choose_stays(stays, task, agent, number):
        cls = class_of(stay, plugins)
        settings = param_file.changes_of(stay.task.settings, dict(sets))
        header = about.get(stay.agent, {})
        speed, virtual = speed_of(header), header.get("clock") == "mission time"
        script = read_script(RecordingReader(path).entries(), stay, cls, speed, virtual)
        outcome = Rerun(stay, script, cls, settings).run()
        comparison = compare(script.outputs, outcome.outputs, stay.task.address, Tolerance(tolerance, time_s))
        row = _row(stay, script, outcome, comparison, most)
        rows.append(row)
        printer.tell(_parts(stay, row, comparison, most))
    printer.emit(rows)
    sys.exit(OK if all(row["agrees"] for row in rows) else REFUSED)


def _row(stay: Stay, script: Script, outcome: Outcome, comparison: RunComparison, most: int) -> dict[str, Any]:
    from pancakes.tools.replay.recorded_run import FAILED, Given

    inputs = sum(isinstance(step, Given) for step in script.steps)
    failed_then = stay.reason if stay.end == FAILED else None
    return {
        "task_id": stay.task_id,
        "agent": stay.agent,
        "address": stay.task.address,
        "type": stay.task.type,
        "from_s": round(stay.begins_s, 6),
        "to_s": round(script.end_s, 6),
        "whole": stay.whole,
        "inputs": inputs,
        "superseded": script.superseded,
        "changes": len(script.steps) - inputs,
        "agrees": comparison.agrees and _error(failed_then or "") == _error(outcome.failed),
        "failed_then": failed_then,
        "failed_now": outcome.failed or None,
        "failed_now_s": outcome.failed_s if outcome.failed else None,
        "notes": [*_notes(stay), *script.notes, *outcome.notes],
        "streams": [
            {"channel": key.channel, "type": key.type, "to": key.to, **vars(counts)}
            for key, counts in comparison.streams.items()
        ],
        "differences": [_plain(difference) for difference in comparison.differences[:most]],
        "differences_left_out": max(0, len(comparison.differences) - most),
    }


def _error(text: str) -> str:
    """Return the sentence of a failure without its line in the code, which an edit may change."""
    return re.sub(r" \([^()]+:\d+, in \S+\)$", "", text)


def _notes(stay: Stay) -> list[str]:
    if stay.whole:
        return []
    return [
        "the task ran already when the recording began: data outside its state, and the position of its random"
        " numbers, are not known"
    ]


def _plain(difference: Difference) -> dict[str, Any]:
    from pancakes.packet import body_to_plain
    from pancakes.tools.replay.comparison import DIFFERENT, key_of

    packet = difference.packet
    return {
        "kind": difference.kind,
        "time_s": packet.stamp_s,
        **key_of(packet)._asdict(),
        "seq": packet.seq,
        "cause": list(packet.cause) if packet.cause is not None else None,
        "fields": [it._asdict() for it in difference.fields],
        "body": None if difference.kind == DIFFERENT else body_to_plain(packet.body),
    }


def _parts(stay: Stay, row: dict[str, Any], comparison: RunComparison, most: int) -> Iterator[Part]:
    yield (
        f"{stay.task_id} ({stay.task.type}) on {stay.agent}, {row['from_s']:.3f} to {row['to_s']:.3f} s:"
        f" {row['inputs']} packets in, {sum(it['recorded'] for it in row['streams'])} out"
    )
    for note in row["notes"]:
        yield f"note: {note}"
    if row["streams"]:
        yield Rows(row["streams"], list(row["streams"][0]))
    for difference in comparison.differences[:most]:
        yield from _lines(difference)
    if row["differences_left_out"]:
        yield f"... and {row['differences_left_out']} more (--show)"
    if row["failed_now"]:
        yield f"{row['failed_now_s']:9.3f} s  it fails now: {row['failed_now']}"
    if row["failed_then"]:
        yield f"{row['to_s']:9.3f} s  it failed then: {row['failed_then']}"
    yield "it agrees with the recording" if row["agrees"] else "it differs from the recording"


def _lines(difference: Difference) -> list[str]:
    from pancakes.packet import body_to_plain
    from pancakes.tools.replay.comparison import DIFFERENT, key_of

    packet = difference.packet
    head = f"{packet.stamp_s:9.3f} s  {_named(key_of(packet))}"
    if difference.kind != DIFFERENT:
        return [f"{head}: {difference.kind}: {_short(body_to_plain(packet.body))}"]
    return [f"{head}: {it.field} was {_short(it.recorded)}, is {_short(it.now)}" for it in difference.fields]


def _named(key: StreamKey) -> str:
    return f"{key.channel} {key.type}" + (f" to {key.to}" if key.to else "")


def _short(value: Any) -> str:
    text = one_line(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
