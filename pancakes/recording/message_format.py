"""One packet as a message of a recording: its data as JSON and back, and its schema in terms that viewers understand.

Foxglove makes a table of a message's fields from its schema. It wants a `type` for each field, `properties` for each
object and `items` for each array, and gives up a whole topic if it finds a reference, a choice or an array of arrays.
What cannot be expressed this way is left out of the schema; the messages still have it.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final

import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError, describe
from pancakes.mesh.codec import encode_packet, packet_from_row, rows_from_payload
from pancakes.packet import Cause, Fence, Packet, body_class, body_from_plain, has_fields
from pancakes.util import codecs
from pancakes.util.arrays import as_list
from pancakes.util.codecs import MALFORMED, why_malformed
from pancakes.util.schema import schema_of

SCHEMAS: Final = "pancakes."
"""The prefix of the names of packet schemas."""
_SIMPLE: Final = {"boolean": bool, "string": str, "integer": int, "number": float}
_KEPT: Final = ("title", "description", "default")


def schema_for(type_name: str) -> dict[str, Any]:
    """Return the JSON Schema of the messages of one packet type; for an unknown type, of any body."""
    cls = body_class(type_name)
    try:
        schema: dict[str, Any] = schema_of(cls) if cls is not None else {}
    except (TypeError, NameError):  # JSON Schema cannot express it, or a part is imported only for type checks
        schema = {}
    body = viewable(schema, schema.get("$defs", {}))
    return {
        "title": SCHEMAS + type_name,
        "description": (
            "A packet. Besides these fields it has `cause`, the source and number of the packet that led to it,"
            " and `fence`, the identity and epoch of the task that published it; both may be null."
        ),
        "type": "object",
        "properties": {
            "source": {"type": "string", "description": "address of the publisher."},
            "destination": {"type": "string", "description": "the address that it is for; empty: all subscribers."},
            "stamp": {"type": "number", "description": "mission time at the publisher, in seconds."},
            "seq": {"type": "integer", "description": "its number among its source's packets."},
            "body": body if body is not None and body["type"] == "object" else {"type": "object", "properties": {}},
            "exact": {
                "type": "string",
                "description": "the packet as it travels, where JSON cannot express all of it.",
            },
        },
    }


def viewable(
    schema: Mapping[str, Any], definitions: Mapping[str, Any], inside: tuple[str, ...] = ()
) -> dict[str, Any] | None:
    """Return a schema in terms that viewers understand; None if it cannot be expressed.

    A value that may be missing (null) is described by its type when it is present.

    Args:
        schema: a schema, as msgspec makes it.
        definitions: what it refers to, by name.
        inside: the names of the definitions around it: a type that contains itself cannot be expanded.
    """
    reference = schema.get("$ref")
    if reference is not None:
        name = reference.rpartition("/")[2]
        if name in inside or name not in definitions:
            return None
        found = viewable(definitions[name], definitions, (*inside, name))
        return found if found is None else {**found, **_kept(schema)}
    if "anyOf" in schema:
        choices = [choice for choice in schema["anyOf"] if choice.get("type") != "null"]
        found = viewable(choices[0], definitions, inside) if len(choices) == 1 else None
        return found if found is None else {**found, **_kept(schema)}
    kind = schema.get("type") or _kind_of(schema.get("enum", ()))
    if kind in _SIMPLE:
        return {"type": kind, **_kept(schema)}
    if kind == "object":
        fields = {name: viewable(field, definitions, inside) for name, field in schema.get("properties", {}).items()}
        there = {name: field for name, field in fields.items() if field is not None}
        return {"type": "object", **_kept(schema), "properties": there}
    if kind == "array":
        items = viewable(_item_of(schema), definitions, inside)
        if items is None or items["type"] == "array":
            return None
        return {"type": "array", **_kept(schema), "items": items}
    return None


def _kept(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {word: schema[word] for word in _KEPT if schema.get(word) is not None}


def _kind_of(values: Any) -> str:
    """Return the common type of all values that a field may have; empty if there are several types."""
    return next((kind for kind, cls in _SIMPLE.items() if values and all(type(it) is cls for it in values)), "")


def _item_of(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the schema of each item of an array; an empty one if they differ."""
    first, *others = schema.get("prefixItems") or [schema.get("items") or {}]
    found: Mapping[str, Any] = first if all(other == first for other in others) else {}
    return found


class _Row(msgspec.Struct, omit_defaults=True, gc=False):
    """The data of a message. A structure takes half as long to create and encode as a mapping."""

    source: str
    destination: str
    stamp: float
    seq: int
    cause: Cause | None
    fence: Fence | None
    body: Any
    exact: str = ""


def data_of(packet: Packet) -> bytes:
    """Return a packet as JSON, the data of a message.

    What JSON cannot express (arrays, infinity and NaN, bytes where the class does not say so) is approximated, and the
    packet is added in its wire format, in the field `exact`. A body that has no wire format either, such as a date in a
    field of any type, is approximated if that can be read again.

    Raises:
        LocalProtocolError: its body cannot be recorded.
    """
    row = _Row(packet.source, packet.destination, packet.stamp_s, packet.seq, packet.cause, packet.fence, packet.body)
    try:
        data = codecs.encode_json(row)
    except Exception:  # a body may run its own code when it is encoded
        return _exact_data(row, packet)
    return data if _holds_body(data, packet.body) else _exact_data(row, packet)


def _holds_body(data: bytes, body: Any) -> bool:
    """Return whether the data of a message contains the whole body of its packet."""
    cls: type = type(body)
    decode = _decode_of(cls)
    if decode is None:
        return False
    try:
        return bool(decode(data).body == body)
    except Exception:  # a class may run its own code when it is created and compared
        return False


@cache
def _decode_of(cls: type) -> Callable[[bytes], Any] | None:
    """Return a decoder of message data with a body of this class; None if there cannot be one."""
    try:
        alone: Any = msgspec.defstruct("_BodyAlone", [("body", cls if has_fields(cls) else Any)])
        decode: Callable[[bytes], Any] = codecs.json_decoder(alone)
    except Exception:  # a class may name a type that is imported only for type checks, or that msgspec cannot create
        return None
    return decode


def _exact_data(row: _Row, packet: Packet) -> bytes:
    try:
        row.exact = base64.b64encode(encode_packet(packet)).decode("ascii")
        return _LISTS(row)
    except Exception as error:  # as in `data_of`
        reason = describe(error)
    row.exact = ""
    try:
        data = codecs.encode_json(row)
        packet_from_data(packet.channel, packet.type, data)
        return data
    except Exception:  # as in `data_of`
        raise LocalProtocolError(
            f"the packet {packet.number} of the type {packet.type!r} from {packet.source} cannot be recorded: {reason}"
        ) from None


_LISTS: Final = codecs.json_encoder(as_list)
_READ: Final[Callable[[bytes], _Row]] = codecs.json_decoder(_Row)
_ONE_MESSAGE: Final = b"\x91"  # the head of a msgpack array of one


def packet_from_data(channel: str, type_name: str, data: bytes) -> Packet:
    """Make a packet from the data of a message; its body becomes the registered class, if there is one.

    Raises:
        RemoteProtocolError: it is not a packet, or the body does not fit its type.
    """
    try:
        row = _READ(data)
        if row.exact:
            return packet_from_bytes(base64.b64decode(row.exact, validate=True))
        body = body_from_plain(type_name, row.body)
        return Packet(channel, type_name, row.source, row.destination, row.stamp, row.seq, body, row.cause, row.fence)
    except RemoteProtocolError:
        raise
    except MALFORMED as error:
        reason = why_malformed(error)
        raise RemoteProtocolError(f"a recorded packet of the type {type_name!r} is malformed: {reason}") from None
    except Exception as error:  # a registered class may run code of its own in __post_init__
        raise RemoteProtocolError(f"a recorded packet of the type {type_name!r} is malformed: {error}") from None


def packet_from_bytes(data: bytes) -> Packet:
    """Make a packet from bytes that `encode_packet` made.

    Raises:
        RemoteProtocolError: it is not a packet, or the body does not fit its type.
    """
    return packet_from_row(rows_from_payload(_ONE_MESSAGE + data)[0])
