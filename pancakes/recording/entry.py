"""One packet of a recording, as one JSON message of an MCAP file, and back."""

from __future__ import annotations

import base64
from typing import Any, Final

import msgpack
import msgspec

from pancakes.errors import LocalProtocolError, PancakesError, RemoteProtocolError
from pancakes.packet import Cause, Fence, Packet, body_from_plain, has_fields
from pancakes.wire.codec import Encoder, packet_from_row, rows_from_payload

NANOSECONDS: Final = 1_000_000_000


class RecordingError(PancakesError):
    """A recording cannot be written or read; the message names the file."""


class Entry(msgspec.Struct, frozen=True):
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


class _Row(msgspec.Struct, omit_defaults=True):
    """The data of a message. A structure takes half as long to make and to encode as a mapping."""

    source: str
    destination: str
    stamp: float
    seq: int
    cause: Cause | None
    fence: Fence | None
    body: Any
    exact: str = ""


class EntryEncoder:
    """Makes the data of messages. Keeps buffers: one to a thread."""

    def __init__(self) -> None:
        self._json = msgspec.json.Encoder(enc_hook=self._foreign)
        self._wire = Encoder()
        self._inexact = False

    def data(self, packet: Packet) -> bytes:
        """Returns a packet as JSON.

        What JSON cannot hold (arrays, bytes, infinity and NaN) is written as well as it goes, and the packet is added
        as it travels between agents, in the field `exact`.

        Raises:
            LocalProtocolError: its body holds what no packet may hold.
        """
        row = _Row(packet.source, packet.destination, packet.stamp, packet.seq, packet.cause, packet.fence, packet.body)
        self._inexact = False
        try:
            data = self._json.encode(row)
            # JSON says null for what is no number, but most nulls are a None.
            nulls = data.count(b"null") > (packet.cause is None) + (packet.fence is None)
            if self._inexact or (nulls and not _holds_body(data, packet)):
                row.exact = base64.b64encode(self._wire.packet(packet)).decode("ascii")
                data = self._json.encode(row)
        except (TypeError, ValueError, OverflowError) as error:
            raise LocalProtocolError(
                f"the packet {packet.seq} of the type {packet.type!r} from {packet.source} cannot be recorded: {error}"
            ) from None
        return data

    def _foreign(self, value: Any) -> Any:
        self._inexact = True
        if hasattr(value, "tolist"):
            return value.tolist()
        raise TypeError(f"a {type(value).__name__} is no plain value")


class _BodyAlone(msgspec.Struct):
    """The data of a message, of which only the body is looked at."""

    body: msgspec.Raw


_BODY_ALONE: Final = msgspec.json.Decoder(_BodyAlone)
_DECODERS: Final[dict[type, msgspec.json.Decoder[Any]]] = {}


def _holds_body(data: bytes, packet: Packet) -> bool:
    """Returns whether the data of a message says all about the body of its packet."""
    raw = _BODY_ALONE.decode(data).body
    try:
        cls = type(packet.body)
        decoder = _DECODERS.get(cls)
        if decoder is None:
            decoder = _DECODERS[cls] = msgspec.json.Decoder(cls if has_fields(cls) else Any)
        return bool(decoder.decode(raw) == packet.body)
    except (msgspec.MsgspecError, TypeError):  # a class that cannot be made of JSON
        return False


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
