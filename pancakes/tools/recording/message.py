"""The data of a message of a recording: one packet as JSON, and back."""

from __future__ import annotations

import base64
from collections.abc import Callable
from functools import cache
from typing import Any, Final

import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError, describe
from pancakes.mesh.wire.codec import Encoder, packet_from_row, rows_from_payload
from pancakes.packet import Cause, Fence, Packet, body_from_plain, has_fields
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.arrays import as_list
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed


class _Row(msgspec.Struct, omit_defaults=True, gc=False):
    """The data of a message. A structure takes half as long to make and to encode as a mapping."""

    source: str
    destination: str
    stamp: float
    seq: int
    cause: Cause | None
    fence: Fence | None
    body: Any
    exact: str = ""


def data_of(packet: Packet) -> bytes:
    """Returns a packet as JSON, the data of a message.

    What JSON cannot express (arrays, infinity and NaN, bytes where the class does not say so) is written as well as it
    goes, and the packet is added as it travels between agents, in the field `exact`. What does not travel either, such
    as a date in a field of any type, is written as well as it goes, if that can be read again.

    Raises:
        LocalProtocolError: its body cannot be recorded.
    """
    row = _Row(packet.source, packet.destination, packet.stamp, packet.seq, packet.cause, packet.fence, packet.body)
    try:
        data = codecs.encode_json(row)
    except Exception:  # what is in a body may run code of its own where it is encoded
        return _exact_data(row, packet)
    return data if _holds_body(data, packet.body) else _exact_data(row, packet)


def _holds_body(data: bytes, body: Any) -> bool:
    """Returns whether the data of a message says all about the body of its packet."""
    cls: type = type(body)
    decode = _decode_of(cls)
    if decode is None:
        return False
    try:
        return bool(decode(data).body == body)
    except Exception:  # a class may run code of its own where it is made, and where it is compared
        return False


@cache
def _decode_of(cls: type) -> Callable[[bytes], Any] | None:
    """Returns what makes something with the body of a class of a message's data; None where that cannot be."""
    try:
        alone: Any = msgspec.defstruct("_BodyAlone", [("body", cls if has_fields(cls) else Any)])
        decode: Callable[[bytes], Any] = codecs.json_decoder(alone)
    except Exception:  # a class may name a type that is imported for checks only, or be one that msgspec cannot make
        return None
    return decode


def _exact_data(row: _Row, packet: Packet) -> bytes:
    try:
        row.exact = base64.b64encode(_WIRE.packet(packet)).decode("ascii")
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
_WIRE: Final = Encoder()
_ONE_MESSAGE: Final = b"\x91"  # the head of a msgpack array of one


def packet_from_data(channel: str, type_name: str, data: bytes) -> Packet:
    """Makes a packet of the data of a message; its body becomes the registered dataclass, where there is one.

    Raises:
        RemoteProtocolError: it is no packet, or the body does not fit its type.
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
    """Makes a packet of the bytes in which it travels alone, as `Encoder.packet` makes them.

    Raises:
        RemoteProtocolError: it is no packet, or the body does not fit its type.
    """
    return packet_from_row(rows_from_payload(_ONE_MESSAGE + data)[0])
