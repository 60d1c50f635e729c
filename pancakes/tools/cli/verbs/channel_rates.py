"""`pancakes channel hz` and `pancakes channel bw`: how often packets come on a channel, and how many bytes that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import click

from pancakes.tools.cli.listening import doubt_types, from_any, from_option, listen, listening_to, types_option
from pancakes.tools.cli.name_types import ChannelName, a_channel
from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.output import show, show_json, show_text
from pancakes.tools.cli.streaming import count_option, for_option, one_line, say
from pancakes.tools.cli.verbs.throughput import WINDOW, Throughput, size_of

EVERY_S: Final = 1.0
"""How often there is a report."""
HZ: Final = ("source", "type", "rate_hz", "min_s", "max_s", "std_dev_s", "window")
BW: Final = ("source", "type", "bytes_per_s", "min_bytes", "mean_bytes", "max_bytes", "window")

_OPTIONS = (
    a_channel,
    types_option,
    from_option,
    click.option(
        "--window",
        metavar="N",
        type=click.IntRange(min=2),
        default=WINDOW,
        show_default=True,
        help="How many packets of each source and type count, the newest.",
    ),
    count_option("packets"),
    for_option,
    asks_agents,
)


def _measures(function: Callable[..., None]) -> Callable[..., None]:
    """Gives a verb what both have."""
    for option in reversed(_OPTIONS):
        function = option(function)
    return function


@click.command()
@_measures
@click.option(
    "--wall-time", is_flag=True, help="Take the times at which packets come here, instead of those they were published."
)
def hz(wall_time: bool, **asked: Any) -> None:
    """Measure how often packets come on a channel: each second until Ctrl-C, or once with --count or --for.

    Each source and type has a row: the rate, the shortest and longest interval, their standard deviation, and over how
    many packets. Times are those of the publisher's mission clock, as rates are everywhere, so that the way here does
    not count; with --wall-time they are this computer's, and it does.
    JSON is a list where the command ends by itself, and else one object a line.

    \b
    Example:
        pancakes channel hz agent1/system --type pose
        pancakes channel hz agent1/system --for 5s --format json
    """
    _measure(HZ, wall_time=wall_time, **asked)


@click.command()
@_measures
def bw(**asked: Any) -> None:
    """Measure how many bytes come on a channel: each second until Ctrl-C, or once with --count or --for.

    Each source and type has a row, the last is for all of them: bytes for each second of this computer's time, and the
    sizes of packets. It counts what each packet takes on the wire; the frames around them add a few bytes.
    JSON is a list where the command ends by itself, and else one object a line.

    \b
    Example:
        pancakes channel bw agent1/system
        pancakes channel bw agent1/system --type ir --for 5s
    """
    _measure(BW, wall_time=True, **asked)


def _measure(
    columns: Sequence[str],
    *,
    wall_time: bool,
    name: ChannelName,
    types: tuple[str, ...],
    sources: tuple[str, ...],
    window: int,
    count: int | None,
    for_s: float | None,
    ask: Ask,
) -> None:
    bounded = count is not None or for_s is not None
    doubt_types(types)
    with listening_to(name, types, ask) as (client, following):
        began_s = reported_s = client.now()
        heard = Throughput(began_s, window, wall_time)

        def report(new_only: bool) -> None:
            rows = heard.rows(client.now(), new_only)
            if columns is BW and len(rows) > 1:
                rows.append(_all(rows))
            _show(rows, columns, ask.format_, bounded, str(name))

        try:
            for packet in listen(client, following, for_s, bounded):
                if packet is not None and from_any(packet.packet.source, sources):
                    heard.add(packet.packet, packet.at_s, size_of(packet.packet))
                    if heard.packets == count:
                        break
                if not bounded and client.now() - reported_s >= EVERY_S:
                    reported_s += EVERY_S
                    report(new_only=True)
        except KeyboardInterrupt:
            if bounded:
                report(new_only=False)
            raise
        if bounded:
            report(new_only=False)


def _all(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the row that sums up the others."""
    packets = sum(row["window"] for row in rows)
    return {
        "source": "all",
        "type": "all",
        "bytes_per_s": sum(row["bytes_per_s"] or 0.0 for row in rows),
        "min_bytes": min(row["min_bytes"] for row in rows),
        "mean_bytes": sum(row["mean_bytes"] * row["window"] for row in rows) / packets,
        "max_bytes": max(row["max_bytes"] for row in rows),
        "window": packets,
    }


def _show(rows: Sequence[dict[str, Any]], columns: Sequence[str], format_: str, bounded: bool, name: str) -> None:
    if not rows:
        say(f"nothing new on {name}")
    if format_ == "table":
        if rows:
            show(rows, columns, format_)
        return
    picked = [{column: row[column] for column in columns} for row in rows]
    if bounded:
        show_json(picked)
    else:
        for row in picked:
            show_text(one_line(row))
