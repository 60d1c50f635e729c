"""Packets as they travel over a link: in runs, which say once what all of their packets have in common.

A run is the array [0, channel, type, source, destination, fence, rows], each row the array [stamp, seq, cause, body].
Packets of a busy source have most often the same head as the one before; so the head is made and checked once for all
of them, and its receiver finds out once where they go.

A body that does not fit its class costs that packet, and not the link: two agents may have learnt a type from different
versions of a plug-in, and what one task gets wrong must not part the others.

All limits are checked before memory is taken: msgspec refuses a length that is more than the bytes that follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final

import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError, WireError
from pancakes.mesh.wire.closed import is_closed
from pancakes.mesh.wire.codec import Seq, Stamp, Text, Word, unsendable
from pancakes.mesh.wire.framing import MAX_MESSAGE_BYTES, array_head
from pancakes.mesh.wire.link_messages import HELLO_NUMBER, LinkMessage
from pancakes.mesh.wire.packet_bodies import encodable, received_body, unpacked
from pancakes.packet import Cause, Fence, Packet, body_class
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed
from pancakes.runtime.weight import is_small

LONGEST_REASON: Final = 1000
"""Of what is wrong with a body no more characters are told: the sentence may quote what a peer made up."""
_ROOM: Final = MAX_MESSAGE_BYTES - 3  # for a head and its rows, behind the longest header of the array of rows

_HEAD_LENGTH: Final = 7


class PacketRun(msgspec.Struct, array_like=True, tag=0, frozen=True, forbid_unknown_fields=True):
    """Packets of one source to one destination, of one type on one channel and under one right, in their order.

    Attributes:
        channel: see `Packet`, as all but the last.
        kind: their type.
        source: as there.
        destination: as there.
        fence: as there.
        rows: the packets, not yet decoded.
    """

    channel: Word
    kind: Word
    source: Word
    destination: Text
    fence: Fence | None
    rows: msgspec.Raw


_FRAME: Final[Callable[[Any], list[PacketRun | LinkMessage]]] = codecs.decoder(
    Annotated[list[PacketRun | LinkMessage], msgspec.Meta(min_length=1)]
)
_Cause = tuple[Text, Seq] | None
_Row = tuple[Stamp, Seq, _Cause, Any]
_Rows = Callable[[Any], list[_Row]]
_RAW_ROWS: Final[Callable[[Any], list[tuple[float, int, Cause | None, msgspec.Raw]]]] = codecs.decoder(
    Annotated[list[tuple[Stamp, Seq, _Cause, msgspec.Raw]], msgspec.Meta(min_length=1)]
)

_DECODERS: Final[dict[type, _Rows | None]] = {}
_SOME_ROWS: Final[_Rows] = codecs.converter(Annotated[list[_Row], msgspec.Meta(min_length=1)])


class Unfit(msgspec.Struct, frozen=True):
    """A packet came whose body does not fit its type, or has a part that no packet may have: no subscriber gets it.

    Attributes:
        packet: the packet, with None for a body.
        reason: a sentence that names it.
    """

    packet: Packet
    reason: str


class _Nobody:
    """The class of no body."""


# Sending ---------------------------------------------------------------------------------------------------------


def head_of(packet: Packet) -> bytes:
    """Returns what the runs of all packets begin with that have this channel, type, source, destination and fence.

    Raises:
        LocalProtocolError: it cannot travel.
    """
    words = (packet.channel, packet.type, packet.source, packet.destination)
    try:
        if not all(words[:3]) or max(map(len, words)) > 256:
            raise LocalProtocolError("its channel, type, source or destination has not 1 to 256 characters")
        return bytes((0x90 | _HEAD_LENGTH, 0)) + b"".join(map(codecs.encode_small, (*words, packet.fence)))
    except (WireError, UnicodeError) as error:
        raise unsendable(packet, error) from None


class RowEncoder:
    """Encodes packets as rows of the runs that begin with `head`, which all of them would have. Any thread.

    Attributes:
        closed: the class of the last body whose class was closed and small: such a body needs no look before it is
            encoded, and no care for how much memory that takes.
        most: so many bytes a row may have.
    """

    __slots__ = ("closed", "most")

    def __init__(self, head: bytes) -> None:
        self.most = _ROOM - len(head)
        self.closed: type = _Nobody

    def encode(self, packet: Packet) -> bytes:
        """Returns a packet as a row.

        Raises:
            LocalProtocolError: a part of it cannot travel, or it is larger than a frame. The sentence names the packet.
        """
        body = packet.body
        try:
            if body.__class__ is not self.closed:
                body = self._look(body)
            encode = codecs.encode_small if body.__class__ is self.closed else codecs.encode
            try:
                row = encode((packet.stamp, packet.seq, packet.cause, body))
            except TypeError:  # a number of numpy's, say, where its class has a number
                row = encode((packet.stamp, packet.seq, packet.cause, encodable(body)))
            if len(row) > self.most:
                raise LocalProtocolError(
                    f"it takes {_ROOM - self.most + len(row)} bytes, and a frame has room for {_ROOM}"
                )
        except Exception as error:  # as in `codec.Encoder.packet`
            raise unsendable(packet, error) from None
        return row

    def _look(self, body: Any) -> Any:
        """Returns a body as it may be encoded, and learns of its class."""
        cls: type = type(body)
        if is_closed(cls):
            if is_small(cls):
                self.closed = cls
            return body
        return encodable(body)


def run_of(head: bytes, rows: Sequence[bytes]) -> bytes:
    """Returns a run of up to 65,535 rows as one message of a frame."""
    return b"".join((head, array_head(len(rows)), *rows))


# Receiving -------------------------------------------------------------------------------------------------------


def messages_from_payload(payload: bytes | memoryview) -> list[PacketRun | LinkMessage]:
    """Takes a frame's payload apart; what is in a run is decoded by `packets_of`.

    Raises:
        RemoteProtocolError: it is not an array of messages, or a message is malformed.
    """
    try:
        return _FRAME(payload)
    except MALFORMED as error:
        raise RemoteProtocolError(f"a frame is malformed: {why_malformed(error)}") from None


def foreign_version(payload: bytes | memoryview, own: int) -> object:
    """Returns the version that the hello of a payload bears where that is not ours; None in any other case.

    The hello of another version may have any form behind its version.
    """
    try:
        messages = unpacked(payload)
    except RemoteProtocolError:
        return None
    if type(messages) is not list or not messages or type(messages[0]) is not list or messages[0][:1] != [HELLO_NUMBER]:
        return None
    version = messages[0][1] if len(messages[0]) > 1 else None
    return None if version == own else version if isinstance(version, int) else "unknown"


def packets_of(run: PacketRun) -> tuple[list[Packet], Sequence[Unfit]]:
    """Returns the packets of a run, whose bodies become the registered class, and those whose bodies do not fit it.

    Raises:
        RemoteProtocolError: they are malformed.
    """
    channel, kind, source, destination, fence = run.channel, run.kind, run.source, run.destination, run.fence
    cls = body_class(kind)
    decoder = _DECODERS[cls] if cls in _DECODERS else _decoder(cls)
    try:
        rows = decoder(run.rows) if decoder is not None else _checked_rows(run)
    except Exception:  # also of a registered class, which may run code of its own in __post_init__
        return _one_by_one(run)
    return [
        Packet(channel, kind, source, destination, stamp, seq, body, cause, fence) for stamp, seq, cause, body in rows
    ], ()


def _checked_rows(run: PacketRun) -> list[_Row]:
    """Decodes rows whose bodies may contain anything: with a look at each part of them."""
    rows = _SOME_ROWS(unpacked(run.rows))
    kind, source = run.kind, run.source
    return [(stamp, seq, cause, received_body(kind, body, source)) for stamp, seq, cause, body in rows]


def _one_by_one(run: PacketRun) -> tuple[list[Packet], list[Unfit]]:
    """Decodes rows of which one at least has something wrong with it."""
    kind, source = run.kind, run.source
    try:
        rows = _RAW_ROWS(run.rows)
    except MALFORMED as error:
        reason = f"a packet of the type {kind!r} from {source} is malformed: {why_malformed(error)}"
        raise RemoteProtocolError(reason) from None
    packets, unfit = [], []
    for stamp, seq, cause, raw in rows:
        packet = Packet(run.channel, kind, source, run.destination, stamp, seq, None, cause, run.fence)
        try:
            packets.append(msgspec.structs.replace(packet, body=received_body(kind, unpacked(raw), source)))
        except RemoteProtocolError as error:
            unfit.append(Unfit(packet, _reason(error, kind, source)))
    return packets, unfit


def _reason(error: RemoteProtocolError, kind: str, source: str) -> str:
    """Returns a sentence that names the packets whose body has this fault."""
    text = str(error)[:LONGEST_REASON]
    return text if text.endswith(f"(from {source})") else f"a packet of the type {kind!r} from {source}: {text}"


def _decoder(cls: type | None) -> _Rows | None:
    """Returns what decodes rows with a body of this class in one go; None where their bodies must be looked at."""
    if cls is None:
        return None
    made: _Rows | None = None
    if is_closed(cls):
        row = tuple[Stamp, Seq, _Cause, cls]  # type: ignore[valid-type]
        made = codecs.decoder(Annotated[list[row], msgspec.Meta(min_length=1)])
    _DECODERS[cls] = made
    return made
