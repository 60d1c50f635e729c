"""`pancakes channel ...`: list channels, show their packets (`echo`), and measure rates and sizes (`hz`, `bw`).

`Throughput` is pure: packets and times go in, rows come out. `pub` is in the module `publish`.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import click
from msgspec.structs import replace

from pancakes.control import Channels
from pancakes.mesh.codec import encode_packet
from pancakes.packet import Packet, agent_of, body_class, body_to_plain, field_names
from pancakes.tools.cli.agent_requests import ask_each, request_result
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.listening import (
    MOST_WAITING,
    doubt_types,
    from_any,
    from_option,
    listen,
    listening_to,
    types_option,
)
from pancakes.tools.cli.options import Ask, ChannelName, Duration, a_channel, an_agent, asks_agents
from pancakes.tools.cli.output import Part, Rows, one_line, show_text
from pancakes.tools.cli.streaming import count_option, for_option, say
from pancakes.tools.cli.verbs.publish import pub
from pancakes.util.text import hint_of

WINDOW: Final = 1000
"""The default of `--window`: the number of newest packets of one source and type that are measured."""


def size_of(packet: Packet) -> int:
    """Return the bytes that a packet takes on the wire, without its destination.

    Call it only in the main thread. The frame around one or several packets adds a few bytes.
    """
    return len(encode_packet(replace(packet, destination="")))


class _Arrival(NamedTuple):
    """One packet: its time, for the intervals; its host time of arrival; its size in bytes."""

    time_s: float
    at_s: float
    size: int


@dataclass(slots=True)
class _PacketSeries:
    """The newest packets of one source and type."""

    newest: deque[_Arrival]
    packets: int = 0
    new: int = 0


class Throughput:
    """Measure the rates and sizes of packets, separately for each source and type.

    Args:
        began_s: the host time at which listening began.
        window: how many of the newest packets of each source and type to measure.
        arrivals: whether to measure intervals between arrivals, in host time, instead of intervals between
            publications, in the publisher's mission time.
    """

    def __init__(self, began_s: float, window: int = WINDOW, arrivals: bool = False) -> None:
        self._began_s = began_s
        self._window = window
        self._arrivals = arrivals
        self._series: dict[tuple[str, str], _PacketSeries] = {}
        self.packets = 0

    def add(self, packet: Packet, at_s: float, size: int = 0) -> None:
        """Add a packet that arrived at a host time."""
        key = (packet.source, packet.type)
        it = self._series.get(key)
        time_s = at_s if self._arrivals else packet.stamp_s
        if it is None or time_s < it.newest[-1].time_s:
            # Mission time went back: the agent was restarted, so begin a new series.
            it = self._series[key] = _PacketSeries(deque(maxlen=self._window))
        it.newest.append(_Arrival(time_s, at_s, size))
        it.packets += 1
        it.new += 1
        self.packets += 1

    def rows(self, now_s: float, new_only: bool = False) -> list[dict[str, Any]]:
        """Return a row for each source and type, sorted by their names.

        Args:
            now_s: host time.
            new_only: whether to leave out series without a new packet since the last call.

        Returns:
            Rows with `source`, `type`, `packets` (all so far), `window` (the number of packets measured), `rate_hz`,
            `min_s`, `max_s` and `std_dev_s` of the intervals (None without an interval), `bytes_per_s` of host time,
            `min_bytes`, `mean_bytes` and `max_bytes`.
        """
        rows = []
        for (source, kind), it in sorted(self._series.items()):
            if it.new or not new_only:
                head = {"source": source, "type": kind, "packets": it.packets, "window": len(it.newest)}
                rows.append({**head, **_intervals(it.newest), **_sizes(it, self._began_s, now_s)})
            it.new = 0
        return rows


def _intervals(newest: deque[_Arrival]) -> dict[str, float | None]:
    intervals = [after.time_s - before.time_s for before, after in pairwise(newest)]
    whole_s = sum(intervals)
    if not intervals or whole_s <= 0.0:  # all stamps are 0 while the mission clock is held
        return {"rate_hz": None, "min_s": None, "max_s": None, "std_dev_s": None}
    rate_hz, spread_s = len(intervals) / whole_s, statistics.pstdev(intervals)
    return {"rate_hz": rate_hz, "min_s": min(intervals), "max_s": max(intervals), "std_dev_s": spread_s}


def _sizes(it: _PacketSeries, began_s: float, now_s: float) -> dict[str, float | None]:
    sizes = [arrival.size for arrival in it.newest]
    if it.packets == len(sizes):
        whole, since_s = sum(sizes), began_s
    else:  # the time begins with the window's first packet, so do not count the bytes of that packet
        whole, since_s = sum(sizes[1:]), it.newest[0].at_s
    return {
        "bytes_per_s": whole / (now_s - since_s) if now_s > since_s else None,
        "min_bytes": min(sizes),
        "mean_bytes": sum(sizes) / len(sizes),
        "max_bytes": max(sizes),
    }


EVERY_S: Final = 1.0
"""The period of the reports."""
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
        help="How many of the newest packets of each source and type to measure.",
    ),
    count_option("packets"),
    for_option,
    asks_agents,
)


def _measures(function: Callable[..., None]) -> Callable[..., None]:
    """Give a verb the arguments and options that `hz` and `bw` share."""
    for option in reversed(_OPTIONS):
        function = option(function)
    return function


@click.command()
@_measures
@click.option(
    "--wall-time", is_flag=True, help="Measure when packets arrive here, instead of when they were published."
)
def hz(wall_time: bool, **options: Any) -> None:
    """Measure the packet rate on a channel: each second until Ctrl-C, or once with --count or --for.

    Each source and type has a row: the rate, the shortest and longest interval, their standard deviation, and the
    number of packets measured. Times are those of the publisher's mission clock, as for all rates, so network delays
    do not count. With --wall-time they are arrival times on this computer.
    JSON is a list if the command ends by itself, otherwise one object per line.

    \b
    Example:
        pancakes channel hz agent1/system --type pose
        pancakes channel hz agent1/system --for 5s --format json
    """
    _measure(HZ, wall_time=wall_time, **options)


@click.command()
@_measures
def bw(**options: Any) -> None:
    """Measure the bandwidth of a channel: each second until Ctrl-C, or once with --count or --for.

    Each source and type has a row, and the last row is for all of them: bytes per second of this computer's time, and
    the sizes of packets. Sizes are those on the wire; the frames around packets add a few bytes.
    JSON is a list if the command ends by itself, otherwise one object per line.

    \b
    Example:
        pancakes channel bw agent1/system
        pancakes channel bw agent1/system --type ir --for 5s
    """
    _measure(BW, wall_time=True, **options)


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
    with listening_to(name, types, ask) as (client, subscriber):
        began_s = reported_s = client.now()
        throughput = Throughput(began_s, window, wall_time)

        def report(new_only: bool) -> None:
            rows = throughput.rows(client.now(), new_only)
            if columns is BW and len(rows) > 1:
                rows.append(_all(rows))
            if not rows:
                say(f"no new packet on {name}")
            picked = [{column: row[column] for column in columns} for row in rows]
            if ask.printer.is_json and not bounded:
                for row in picked:
                    show_text(one_line(row))
            else:
                ask.printer.emit(picked, Rows(picked, columns) if picked else "")

        try:
            for packet in listen(client, subscriber, for_s, bounded):
                if packet is not None and from_any(packet.packet.source, sources):
                    throughput.add(packet.packet, packet.at_s, size_of(packet.packet))
                    if throughput.packets == count:
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
    """Return the row that sums up all others."""
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


WIDE: Final = 100
"""A list or mapping that takes more characters than this is shown on several lines."""
LONG: Final = 500
"""A longer text, such as an image, is shown by its beginning; `--format json` and `--field` show all of it."""
HEADER: Final = "packet."
"""The prefix of fields of the packet's header, as opposed to its body."""


@click.command()
@a_channel
@types_option
@from_option
@click.option(
    "--field",
    "fields",
    metavar="PATH",
    multiple=True,
    help="Show only this field of the body, such as x_m or ranges_m.0, or of the header: packet.stamp_s, packet.source,"
    " packet.type, packet.seq. Repeatable.",
)
@count_option("packets")
@for_option
@asks_agents
def echo(
    name: ChannelName,
    types: tuple[str, ...],
    sources: tuple[str, ...],
    fields: tuple[str, ...],
    count: int | None,
    for_s: float | None,
    ask: Ask,
) -> None:
    """Show the packets on a channel, including those from other agents, until Ctrl-C.

    Each packet is a YAML document, or with --field a line of values that are separated by tabs. JSON is a list if the
    command ends by itself (--count, --for), otherwise one object per line.
    If an agent goes away, the command waits for it. With --count or --for the exit code is 3 if it does not come back.

    \b
    Example:
        pancakes channel echo agent1/system --type pose
        pancakes channel echo agent1/system --type ir --field ranges_m.0 --count 10
        pancakes channel echo agent1/log --from agent1/client --format json
    """
    bounded = count is not None or for_s is not None
    paths = FieldPaths(fields)
    doubt_types(types)
    _check_fields(types, fields)
    with (
        listening_to(name, types, ask) as (client, subscriber),
        ask.printer.stream(bounded, paths.text if fields else text_of) as stream,
    ):
        for received in listen(client, subscriber, for_s, bounded):
            if received is None or not from_any(received.packet.source, sources):
                continue
            record = record_of(received.agent, received.packet)
            picked = paths.pick(record) if fields else record
            if picked is not None:
                stream.show(picked)
            if stream.printed == count:
                break


def _check_fields(types: Sequence[str], fields: Sequence[str]) -> None:
    """Refuse a field that no packet of the wanted types can have: waiting for it would never end."""
    classes = [body_class(name) for name in types]
    known = [name for cls in classes if cls is not None for name in field_names(cls)]
    if not types or None in classes:
        return
    for path in fields:
        first = path.split(".")[0]
        if not path.startswith(HEADER) and first not in known:
            hint = hint_of(first, list(dict.fromkeys(known)))
            raise click.UsageError(f"{' and '.join(types)} has no field {first!r}{hint}")


def record_of(agent: str, packet: Packet) -> dict[str, Any]:
    """Return a packet that was received from an agent, as plain values."""
    return {
        "agent": agent,
        "channel": packet.channel,
        "type": packet.type,
        "source": packet.source,
        "stamp_s": packet.stamp_s,
        "seq": packet.seq,
        "number": packet.number,
        "cause": list(packet.cause) if packet.cause is not None else None,
        "body": body_to_plain(packet.body),
    }


def text_of(record: Mapping[str, Any]) -> str:
    """Return a record as a YAML document."""
    lines = [f"{key}: {_scalar(record[key])}" for key in ("type", "source", "stamp_s", "number")]
    return "\n".join([*lines, *_lines("body", record["body"], ""), "---"])


def _lines(key: str, value: Any, indent: str) -> list[str]:
    if isinstance(value, str) and len(value) > LONG:
        return [f"{indent}{key}: {one_line(value[:WIDE])} # the first {WIDE} of {len(value)} characters"]
    short = _scalar(value)
    if isinstance(value, Mapping) and value:
        return [
            f"{indent}{key}:",
            *(line for name, it in value.items() for line in _lines(_key(name), it, indent + "  ")),
        ]
    if not isinstance(value, list | tuple) or len(short) <= WIDE:
        return [f"{indent}{key}: {short}"]
    return [f"{indent}{key}:", *(f"{indent}  - {_scalar(item)}" for item in value)]


def _key(name: str) -> str:
    return name if name.isidentifier() else one_line(name)


def _scalar(value: Any) -> str:
    """Format a value on one line, as JSON (which is YAML); a string that is a plain word gets no quotes."""
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, str) and value and all(part.isidentifier() for part in value.replace("-", "_").split("/")):
        return value if value.lower() not in ("true", "false", "null", "yes", "no", "on", "off") else one_line(value)
    return one_line(value)


class FieldPaths:
    """Select fields of packets.

    Args:
        paths: the fields, as in `--field`.
    """

    def __init__(self, paths: Sequence[str]) -> None:
        self._paths = tuple(paths)
        self._reported: set[str] = set()

    def pick(self, record: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return the fields of a packet by path, with None for missing ones; None if it has none of the body fields."""
        found = {path: _at(record, path) for path in self._paths}
        header_only = all(path.startswith(HEADER) for path in self._paths)
        if header_only or any(it for path, it in found.items() if not path.startswith(HEADER)):
            return {path: it[0] if it else None for path, it in found.items()}
        kind = record["type"]
        if kind not in self._reported:
            self._reported.add(kind)
            body = record["body"]
            has = f"only {', '.join(body)}" if isinstance(body, Mapping) and body else "it has no fields"
            wanted = " or ".join(path for path in self._paths if not path.startswith(HEADER))
            say(f"packets of the type {kind} are skipped: they have no {wanted}, {has}")
        return None

    def text(self, picked: Mapping[str, Any]) -> str:
        """Return picked fields as a line."""
        return "\t".join(_scalar(value) for value in picked.values())


def _at(record: Mapping[str, Any], path: str) -> tuple[Any, ...]:
    """Return the value at a path in a tuple, which is empty if the path does not exist."""
    if path.startswith(HEADER):
        value, steps = dict(record), path.removeprefix(HEADER).split(".")
    else:
        value, steps = record["body"], path.split(".")
    for step in steps:
        if isinstance(value, Mapping) and step in value:
            value = value[step]
        elif isinstance(value, list | tuple) and step.lstrip("-").isdecimal() and -len(value) <= int(step) < len(value):
            value = value[int(step)]
        else:
            return ()
    return (value,)


LISTED = ("agent", "channel", "core", "subscribers", "waiting", "dropped", "followers")
SUBSCRIBERS = ("subscriber", "types", "queue", "limit", "waiting", "dropped")
PUBLISHERS = ("publisher", "type", "packets", "rate_hz", "bytes_per_s")


SECTIONS: Final = {
    "Read": {
        "list": "List channels.",
        "info": "Show who subscribes to a channel.",
        "echo": "Show the packets on a channel.",
        "hz": "Measure the packet rate of a channel.",
        "bw": "Measure the bandwidth of a channel.",
    },
    "Write": {
        "pub": "Publish a packet.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def channel() -> None:
    """Show channels, and the packets on them."""


for verb in (echo, hz, bw, pub):
    channel.add_command(verb)


@channel.command("list")
@an_agent
@asks_agents
def list_(agent: str, ask: Ask) -> None:
    """List the channels of all agents, or of AGENT.

    For each channel it shows how many components subscribe to it, how many packets wait for them, how many packets they
    lost, and how many terminals and other agents follow it.

    \b
    Example:
        pancakes channel list
        pancakes channel list agent1 --format json
    """
    rows = [
        {
            **found,
            "subscribers": len(found["subscribers"]),
            "waiting": sum(reader["waiting"] for reader in found["subscribers"]),
            "dropped": sum(reader["dropped"] for reader in found["subscribers"]),
            "followers": len(found["followers"]),
        }
        for _, result in ask_each(ask, Channels(), agent)
        for found in result
    ]
    ask.printer.table(rows, LISTED)


@channel.command()
@a_channel
@click.option(
    "--for",
    "for_s",
    metavar="TIME",
    type=Duration(),
    default="1s",
    show_default=True,
    help="How long to listen for publishers.",
)
@asks_agents
def info(name: ChannelName, for_s: float, ask: Ask) -> None:
    """Show which components subscribe to a channel, which clients follow it, and which sources publish on it.

    Components do not declare what they publish, so this command listens; a rare publisher may need a longer --for.
    Rates are packets per second of the publisher's mission time, bytes are per second of this computer's time.

    \b
    Example:
        pancakes channel info agent1/system
        pancakes channel info agent1/ctrl --for 10s --format json
    """
    with ask.client() as client:
        (found,) = request_result(client, name.agent, Channels(name.channel))
        throughput = Throughput(client.now())
        with client.subscribe(str(name), include_remote=True, max_waiting=MOST_WAITING) as subscriber:
            for packet in listen(client, subscriber, for_s):
                if packet is not None:
                    throughput.add(packet.packet, packet.at_s, size_of(packet.packet))
        publishers = [row for row in throughput.rows(client.now()) if not client.is_own(agent_of(row["source"]))]
    row = {**found, "publishers": publishers, "heard_s": for_s}
    ask.printer.emit([row], _parts(row))


def _parts(row: dict[str, Any]) -> Iterator[Part]:
    kind = "a core channel" if row["core"] else "a channel"
    yield f"{row['agent']}/{row['channel']} is {kind}"
    subscribers = [
        {**it, "subscriber": it["address"], "types": _types(it["types"], it["open_types"])} for it in row["subscribers"]
    ]
    yield Rows(subscribers, SUBSCRIBERS) if subscribers else "\nNo component of this agent subscribes to it."
    yield "Followed from elsewhere by " + (", ".join(row["followers"]) or "none") + "."
    if row["publishers"]:
        yield Rows([{**it, "publisher": it["source"]} for it in row["publishers"]], PUBLISHERS)
    else:
        yield f"No packet was published on it within {row['heard_s']:g} s."


def _types(types: list[str] | None, open_types: list[str] | None) -> str:
    """Return the types that a subscriber gets; it gets those in brackets only in packets that are addressed to it."""
    if types is None:
        return "all" if open_types is None else ", ".join([*open_types, "(all)"])
    return ", ".join(name if open_types is None or name in open_types else f"({name})" for name in types)
