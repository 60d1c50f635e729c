"""Bodies of packets as JSON, and out of it. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pancakes.errors import RemoteProtocolError
from pancakes.packet import Packet, body_class, body_from_plain, body_to_plain, field_names
from pancakes.settings import required_keys
from pancakes_mqtt.payloads import BadPayload, plain_json, value_at


def payload_of(packet: Packet, whole: bool) -> bytes:
    """Returns a packet as JSON, in which NaN and infinity are null.

    Args:
        packet: the packet.
        whole: whether more of it than its body is told.

    Raises:
        BadPayload: JSON has no words for it.
    """
    try:
        body = body_to_plain(packet.body)
    except (TypeError, ValueError, RecursionError) as error:
        raise BadPayload(f"it cannot be said in JSON: {error}") from None
    if not whole:
        return plain_json(body)
    told = {"source": packet.source, "type": packet.type, "stamp": packet.stamp, "seq": packet.seq, "body": body}
    return plain_json(told)


def body_in(payload: bytes, kind: str, paths: Mapping[str, str]) -> Any:
    """Returns the body of a packet that a payload tells of.

    Args:
        payload: JSON.
        kind: the type of the packet.
        paths: the path of each field that has another than its own name.

    Raises:
        BadPayload: there is none in it.
    """
    cls = body_class(kind)
    names = field_names(cls) if cls is not None else ()
    value = value_at(payload, "")
    if isinstance(value, Mapping):
        plain = {name: value[name] for name in names if name in value and name not in paths}
        plain.update({name: value_at(payload, path) for name, path in paths.items()})
    elif cls is not None and len(needed := required_keys(cls) or names) == 1:
        plain = {next(iter(needed)): value}
    else:
        raise BadPayload(f"{kind} has the fields {', '.join(names) or 'none'}, and the payload is no JSON object")
    try:
        return body_from_plain(kind, plain)
    except RemoteProtocolError as error:
        raise BadPayload(str(error)) from None
