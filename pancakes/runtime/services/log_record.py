"""What is said on `log`, as a record of a JSON lines file."""

from __future__ import annotations

from typing import Any, Final

from pancakes.events import Event, LogLine
from pancakes.packet import Packet, agent_of, body_to_plain
from pancakes.runtime.foundation.arrays import without_arrays
from pancakes.runtime.foundation.printable import printable_data

_ENVELOPE: Final = ("t_s", "agent", "source", "kind", "entry", "utc")
"""What a record says of itself."""


def record_of(packet: Packet) -> dict[str, Any]:
    """Returns a packet of `log` as one record of a JSON lines file.

    Who said it and when is as the packet says, whatever an event claims: a field that bears one of these names has a
    `_` behind it.
    """
    record: dict[str, Any] = {"t_s": round(packet.stamp, 6), "agent": agent_of(packet.source), "source": packet.source}
    body = packet.body
    if isinstance(body, Event):
        record["kind"] = body.kind
        fields = without_arrays(body.fields)
        return record | {f"{key}_" if key in _ENVELOPE else key: value for key, value in fields.items()}
    if isinstance(body, LogLine):
        record = {**record, "kind": "line", "level": body.level, "text": body.text}
        return {**record, "traceback": body.traceback} if body.traceback else record
    return {**record, "kind": packet.type, "body": body_to_plain(body)}


def line_of(record: dict[str, Any]) -> str:
    """Returns a record as one line of JSON, its keys in their order."""
    import json  # takes 2 ms of an agent's start, for files and questions that most agents never see

    return printable_data(json.dumps(record, ensure_ascii=False, default=str, separators=(", ", ": ")))
