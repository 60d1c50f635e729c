"""One packet of a recording, as one JSON message of an MCAP file, and back."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, Final

import msgpack
import msgspec

from pancakes.errors import LocalProtocolError, PancakesError, RemoteProtocolError
from pancakes.packet import Cause, Fence, Packet, body_from_plain, has_fields
from pancakes.weight import weigher
from pancakes.wire.codec import Encoder, packet_from_row, rows_from_payload

NANOSECONDS: Final = 1_000_000_000


class RecordingError(PancakesError):
    """A recording cannot be written or read; the message names the file."""


class Entry(msgspec.Struct, frozen=True, gc=False):
    """One packet as it was seen.

    Attributes:
        time_ns: when it was recorded, in nanoseconds: since 1970 where agents run live, since the agents were made
            in virtual time.
        agent: the agent on whose channel it was seen; a packet that travels is seen where it comes from, and where it
            comes to.
        packet: the packet.
    """

    time_ns: int
    agent: str
    packet: Packet

    @property
    def topic(self) -> str:
        """The MCAP topic that it belongs to."""
        return f"/{self.agent}/{self.packet.channel}/{self.packet.type}"

    @property
    def task_id(self) -> str:
        """The identity for life of the task that published it, whichever agent it was on; empty where none did."""
        return self.packet.fence.task_id if self.packet.fence is not None else ""


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


def data_of(packets: Sequence[Packet]) -> list[bytes | LocalProtocolError]:
    """Returns packets as JSON, the data of messages; in the place of one whose body holds what no packet may hold, why.

    What JSON cannot hold (arrays, bytes, infinity and NaN) is written as well as it goes, and the packet is added as it
    travels between agents, in the field `exact`.
    """
    try:
        # All at once takes a third less than one by one. JSON has no line breaks of its own.
        lines = _PLAIN.encode_lines([_row(packet) for packet in packets]).splitlines()
    except _CANNOT_ENCODE:
        lines = []
    if len(lines) != len(packets):
        return [_data_of_one(packet) for packet in packets]
    return [
        line if _says_all(line, packet) else _exact_data(packet) for line, packet in zip(lines, packets, strict=True)
    ]


def _data_of_one(packet: Packet) -> bytes | LocalProtocolError:
    try:
        data = _PLAIN.encode(_row(packet))
    except _CANNOT_ENCODE:
        return _exact_data(packet)
    return data if _says_all(data, packet) else _exact_data(packet)


def _says_all(data: bytes, packet: Packet) -> bool:
    """Returns whether the data of a message says all about the body of its packet."""
    # JSON says null for what is no number, and text for bytes: but where a body is all numbers, only null can lie.
    cls = type(packet.body)
    if weigher(cls) is None and data.count(b"null") == (packet.cause is None) + (packet.fence is None):
        return True
    try:
        decoder = _DECODERS.get(cls)
        if decoder is None:
            body = cls if has_fields(cls) else Any
            decoder = _DECODERS[cls] = msgspec.json.Decoder(msgspec.defstruct("_BodyAlone", [("body", body)]))
        return bool(decoder.decode(data).body == packet.body)
    except (msgspec.MsgspecError, TypeError):  # a class that cannot be made of JSON
        return False


def _exact_data(packet: Packet) -> bytes | LocalProtocolError:
    row = _row(packet)
    try:
        row.exact = base64.b64encode(_WIRE.packet(packet)).decode("ascii")
        return _LISTS.encode(row)
    except (*_CANNOT_ENCODE, LocalProtocolError) as error:
        return LocalProtocolError(
            f"the packet {packet.seq} of the type {packet.type!r} from {packet.source} cannot be recorded: {error}"
        )


def _row(packet: Packet) -> _Row:
    return _Row(packet.source, packet.destination, packet.stamp, packet.seq, packet.cause, packet.fence, packet.body)


def _list(array: Any) -> Any:
    if hasattr(array, "tolist"):
        return array.tolist()
    raise TypeError(f"a {type(array).__name__} is no plain value")


_CANNOT_ENCODE: Final = (TypeError, ValueError, OverflowError, RecursionError, msgspec.MsgspecError)
_PLAIN: Final = msgspec.json.Encoder()
_LISTS: Final = msgspec.json.Encoder(enc_hook=_list)
_WIRE: Final = Encoder()
_DECODERS: Final[dict[type, msgspec.json.Decoder[Any]]] = {}


def packet_from_data(channel: str, type_name: str, data: bytes) -> Packet:
    """Makes a packet of the data of a message; its body becomes the registered dataclass, where there is one.

    Raises:
        RemoteProtocolError: it is no packet, or the body does not fit its type.
    """
    try:
        row = msgspec.json.decode(data)
        exact = row.get("exact")
        if exact is not None:
            packed = base64.b64decode(exact, validate=True)
            return packet_from_row(rows_from_payload(msgpack.packb([msgpack.unpackb(packed, ext_hook=_keep)]))[0])
        cause = row["cause"]
        return Packet(
            channel,
            type_name,
            row["source"],
            row["destination"],
            float(row["stamp"]),
            int(row["seq"]),
            body_from_plain(type_name, row["body"]),
            (cause[0], cause[1]) if cause else None,
            msgspec.convert(row["fence"], Fence | None),
        )
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise RemoteProtocolError(f"a recorded packet of the type {type_name!r} is malformed: {error}") from None


def _keep(code: int, data: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(code, data)
