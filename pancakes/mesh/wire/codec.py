"""A packet by itself as msgpack and back: in a letter to a task, or in a recording.

It is the array [channel, type, source, destination, stamp, seq, cause, body, fence]. Over a link packets travel in
runs, see `pancakes.mesh.wire.runs`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final

import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError, WireError, describe
from pancakes.mesh.wire.framing import MAX_MESSAGE_BYTES, MAX_PAYLOAD_BYTES
from pancakes.mesh.wire.link_messages import LinkMessage
from pancakes.mesh.wire.packet_bodies import encodable, received_body, unpacked
from pancakes.packet import Fence, Packet, agent_of
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED

Text = Annotated[str, msgspec.Meta(max_length=256)]
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
Stamp = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Seq = Annotated[int, msgspec.Meta(ge=0)]


_PARTS: Final = codecs.decoder(list[msgspec.Raw])
_TEXT: Final = codecs.decoder(str)
_NUMBER: Final = codecs.decoder(float)
_SOURCE: Final = 2
_STAMP: Final = 4
"""Where in the array the source stands."""


class _PacketRow(msgspec.Struct, array_like=True, forbid_unknown_fields=True, gc=False):
    """The checks that a packet's array goes through (msgspec remembers those of a class, not those of a tuple)."""

    channel: Word
    type: Word
    source: Word
    destination: Text
    stamp: Stamp
    seq: Seq
    cause: tuple[Text, Seq] | None
    body: Any
    fence: Fence | None


def unsendable(packet: Packet, error: Exception) -> LocalProtocolError:
    """Returns the sentence that names a packet and says why it cannot be sent."""
    why = str(error) if isinstance(error, (WireError, *codecs.UNENCODABLE)) else describe(error)
    return LocalProtocolError(
        f"the packet {packet.number} of the type {packet.type!r} from {packet.source} cannot be sent: {why}"
    )


class Encoder:
    """Encodes packets and link messages."""

    def packet(self, packet: Packet) -> bytes:
        """Returns a packet as msgpack.

        Raises:
            LocalProtocolError: a part of it cannot travel, or it is larger than a frame. The sentence names the packet.
        """
        try:
            body = encodable(packet.body)
            message = codecs.encode(
                (
                    packet.channel,
                    packet.type,
                    packet.source,
                    packet.destination,
                    packet.stamp,
                    packet.seq,
                    packet.cause,
                    body,
                    packet.fence,
                )
            )
            if len(message) > MAX_MESSAGE_BYTES:
                raise LocalProtocolError(f"it takes {len(message)} bytes, and a frame has room for {MAX_MESSAGE_BYTES}")
        except Exception as error:  # what is in a body may run code of its own where it is encoded
            raise unsendable(packet, error) from None
        return message

    def link_message(self, message: LinkMessage) -> bytes:
        """Returns a message of the link as one message of a frame."""
        return codecs.encode_small(message)


def of_agent(packet: bytes, agent: str, restamped: Callable[[str, float], float]) -> bytes:
    """Returns a packet, as `Encoder.packet` made it, of which the source has moved to another agent.

    What is no packet stays as it is.

    Args:
        packet: the packet.
        agent: the agent that the source is on now.
        restamped: takes the agent that the source was on and a stamp of it; returns the stamp of the other one.
    """
    try:
        row = _PARTS(packet)
        source, stamp_s = _TEXT(row[_SOURCE]), _NUMBER(row[_STAMP])
    except (*MALFORMED, IndexError):
        return packet
    before = agent_of(source)
    row[_SOURCE] = msgspec.Raw(codecs.encode_small(agent + source[len(before) :]))
    row[_STAMP] = msgspec.Raw(codecs.encode_small(restamped(before, stamp_s)))
    return codecs.encode_small(row)


def rows_from_payload(payload: bytes) -> list[list[Any]]:
    """Takes an array of packets, each of them as `Encoder.packet` made it, apart, within the limits of memory.

    What is in a packet is checked when it is made of its array.

    Raises:
        RemoteProtocolError: it is not a msgpack array of arrays, or breaks a limit.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise RemoteProtocolError(f"a frame of {len(payload)} bytes is longer than {MAX_PAYLOAD_BYTES}")
    rows = unpacked(payload)
    if type(rows) is not list or not rows:
        raise RemoteProtocolError("a frame has no array of messages")
    for row in rows:
        if type(row) is not list or not row or type(row[0]) not in (str, int):
            raise RemoteProtocolError("a frame has a message that is neither a packet nor the link's own")
    return rows


def packet_from_row(row: list[Any]) -> Packet:
    """Makes a packet from the array that came in; its body becomes the registered dataclass.

    Raises:
        RemoteProtocolError: the array is no packet, or the body does not fit its type.
    """
    try:
        it = codecs.convert(row, _PacketRow)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"a packet is malformed: {error}") from None
    body = received_body(it.type, it.body, it.source)
    return Packet(it.channel, it.type, it.source, it.destination, it.stamp, it.seq, body, it.cause, it.fence)
