"""`pancakes channel echo`: shows the packets on a channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import click

from pancakes.packet import Packet, body_class, body_to_plain, field_names
from pancakes.runtime.foundation.suggestion import hint_of
from pancakes.tools.cli.listening import doubt_types, from_any, from_option, listen, listening_to, types_option
from pancakes.tools.cli.name_types import ChannelName, a_channel
from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.streaming import Printer, count_option, for_option, one_line, say

WIDE: Final = 100
"""A list or mapping that takes more characters than this is shown on several lines."""
HEADER: Final = "packet."
"""What the name of a field begins with that is the packet's own, and not of its body."""


@click.command()
@a_channel
@types_option
@from_option
@click.option(
    "--field",
    "fields",
    metavar="PATH",
    multiple=True,
    help="Only this field of the body, such as x_m or ranges_m.0; packet.stamp, packet.source, packet.type and"
    " packet.seq are the packet's own. Repeatable.",
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
    """Show the packets on a channel, those too that come from other agents, until Ctrl-C.

    For people each packet is a YAML document, or with --field a line whose values are separated by tabs. JSON is a
    list where the command ends by itself (--count, --for), and else one object a line.
    An agent that goes away is waited for; with --count or --for, exit code 3 says that it did not come back.

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
        listening_to(name, types, ask) as (client, following),
        Printer(ask.format_, bounded, paths.text if fields else text_of) as printer,
    ):
        for heard in listen(client, following, for_s, bounded):
            if heard is None or not from_any(heard.packet.source, sources):
                continue
            record = record_of(heard.agent, heard.packet)
            picked = paths.pick(record) if fields else record
            if picked is not None:
                printer.show(picked)
            if printer.printed == count:
                break


def _check_fields(types: Sequence[str], fields: Sequence[str]) -> None:
    """Refuses a field that no packet of the wanted types can have: it would be waited for in vain."""
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
    """Returns a packet that was heard on an agent as plain values."""
    return {
        "agent": agent,
        "channel": packet.channel,
        "type": packet.type,
        "source": packet.source,
        "stamp": packet.stamp,
        "seq": packet.seq,
        "number": packet.number,
        "cause": list(packet.cause) if packet.cause is not None else None,
        "body": body_to_plain(packet.body),
    }


def text_of(record: Mapping[str, Any]) -> str:
    """Returns a record as a YAML document."""
    lines = [f"{key}: {_scalar(record[key])}" for key in ("type", "source", "stamp", "number")]
    return "\n".join([*lines, *_lines("body", record["body"], ""), "---"])


def _lines(key: str, value: Any, indent: str) -> list[str]:
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
    """Returns a value in one line; JSON is YAML, but a string that is plainly a word needs no quotes."""
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, str) and value and all(part.isidentifier() for part in value.replace("-", "_").split("/")):
        return value if value.lower() not in ("true", "false", "null", "yes", "no", "on", "off") else one_line(value)
    return one_line(value)


class FieldPaths:
    """Picks fields out of packets.

    Args:
        paths: the fields, as in `--field`.
    """

    def __init__(self, paths: Sequence[str]) -> None:
        self._paths = tuple(paths)
        self._told: set[str] = set()

    def pick(self, record: Mapping[str, Any]) -> dict[str, Any] | None:
        """Returns the fields of a packet by their paths, null where it has not all of them; None where it has none."""
        found = {path: _at(record, path) for path in self._paths}
        own = all(path.startswith(HEADER) for path in self._paths)
        if own or any(it for path, it in found.items() if not path.startswith(HEADER)):
            return {path: it[0] if it else None for path, it in found.items()}
        kind = record["type"]
        if kind not in self._told:
            self._told.add(kind)
            body = record["body"]
            has = f"only {', '.join(body)}" if isinstance(body, Mapping) and body else "it has no fields"
            wanted = " or ".join(path for path in self._paths if not path.startswith(HEADER))
            say(f"packets of the type {kind} are left out: they have no {wanted}, {has}")
        return None

    def text(self, picked: Mapping[str, Any]) -> str:
        """Returns picked fields as a line."""
        return "\t".join(_scalar(value) for value in picked.values())


def _at(record: Mapping[str, Any], path: str) -> tuple[Any, ...]:
    """Returns what is at a path, as the only item of a tuple; an empty one where there is nothing."""
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
