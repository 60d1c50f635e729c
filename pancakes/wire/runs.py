"""Packets as they travel over a link: in runs, which say once what all of their packets have in common.

A run is the array [0, channel, type, source, destination, rows], each row the array [stamp, seq, cause, body, fence].
Packets of a busy source have most often the same head as the one before; so the head is made and checked once for all
of them, and its receiver finds out once where they go. Measured with 100 packets of two numbers: 0.4 µs each to
encode, where an array for each took 1.4, and 0.4 µs to decode, where it took 2.0.

All limits are checked before memory is taken: msgspec refuses a length that is more than the bytes that follow.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final

import msgspec
from msgspec import inspect

from pancakes.errors import LocalProtocolError, RemoteProtocolError, WireError
from pancakes.packet import Fence, Packet, body_class
from pancakes.wire.bodies import encodable, encodable_of, received_body, unpacked
from pancakes.wire.codec import Seq, Stamp, Text, Word, unsendable
from pancakes.wire.framing import MAX_MESSAGE_BYTES
from pancakes.wire.messages import HELLO_NUMBER, LinkMessage

MAX_ROWS: Final = 65_535
"""Most packets in a run."""
_ROOM: Final = MAX_MESSAGE_BYTES - 3  # for a head and its rows, behind the longest header of the array of rows

_ENCODE: Final = msgspec.msgpack.Encoder().encode
_HEAD_LENGTH: Final = 6
_FRAME_OF_ONE: Final = struct.Struct(">IB")  # a frame's length, and the head of its array of one message
_ARRAYS: Final = tuple(bytes((0x90 | count,)) for count in range(16))  # the heads of short arrays


class Run(msgspec.Struct, array_like=True, tag=0, frozen=True, forbid_unknown_fields=True):
    """Packets of one source to one destination, of one type on one channel, in their order.

    Attributes:
        channel: see `Packet`, as all but the last.
        kind: their type.
        source: as there.
        destination: as there.
        rows: the packets, not yet decoded.
    """

    channel: Word
    kind: Word
    source: Word
    destination: Text
    rows: msgspec.Raw


_FRAME: Final = msgspec.msgpack.Decoder(Annotated[list[Run | LinkMessage], msgspec.Meta(min_length=1)])
_Cause = tuple[Text, Seq] | None
_Row = tuple[Stamp, Seq, _Cause, Any, Fence | None]
_Rows = msgspec.msgpack.Decoder[list[_Row]]

_DECODERS: Final[dict[type, _Rows | None]] = {}
_NO_ROWS: Final = msgspec.Raw()


# Sending ---------------------------------------------------------------------------------------------------------


def head_of(packet: Packet) -> bytes:
    """Returns what the runs of all packets begin with that have this channel, type, source and destination.

    Raises:
        LocalProtocolError: it cannot travel.
    """
    words = (packet.channel, packet.type, packet.source, packet.destination)
    try:
        if not all(words[:3]) or max(map(len, words)) > 256:
            raise LocalProtocolError("its channel, type, source or destination has not 1 to 256 characters")
        return bytes((0x90 | _HEAD_LENGTH, 0)) + b"".join(map(_ENCODE, words))
    except (WireError, UnicodeError) as error:
        raise unsendable(packet, error) from None


class RowEncoder:
    """Encodes packets of one channel, type, source and destination as rows of the runs that begin with `head`.

    What they nearly always have in common besides, the class of their bodies and their fence, is looked at once.
    Measured with a dataclass of two fields: 0.47 µs a packet, where looking at each took 0.67. Any thread.
    """

    __slots__ = ("_known", "_most")

    def __init__(self, head: bytes) -> None:
        self._most = _ROOM - len(head)
        # Replaced as a whole, because several threads may publish for one source.
        self._known: tuple[type, Callable[[Any], Any], Fence | None, msgspec.Raw | None]
        self._known = (type(None), encodable, None, None)

    def encode(self, packet: Packet) -> bytes:
        """Returns a packet as a row.

        Raises:
            LocalProtocolError: it holds what cannot travel, or is larger than a frame. The sentence names the packet.
        """
        body = packet.body
        try:
            cls, encodable_of_class, fence, raw_fence = self._known
            if body.__class__ is not cls or packet.fence is not fence:
                _, encodable_of_class, _, raw_fence = self._learn(packet)
            row = _ENCODE((packet.stamp, packet.seq, packet.cause, encodable_of_class(body), raw_fence))
            if len(row) > self._most:
                raise LocalProtocolError(f"it takes {_ROOM - self._most + len(row)} bytes, and a frame holds {_ROOM}")
        except (WireError, OverflowError, UnicodeError, TypeError, ValueError) as error:
            raise unsendable(packet, error) from None
        return row

    def _learn(self, packet: Packet) -> tuple[type, Callable[[Any], Any], Fence | None, msgspec.Raw | None]:
        cls, fence = type(packet.body), packet.fence
        raw_fence = msgspec.Raw(_ENCODE(fence)) if fence is not None else None
        self._known = (cls, encodable_of(cls), fence, raw_fence)
        return self._known


def run_of(head: bytes, rows: Sequence[bytes]) -> bytes:
    """Returns a run as one message of a frame; not more than `MAX_ROWS` rows."""
    return b"".join((head, _array_of(len(rows)), *rows))


def framed_run(head: bytes, rows: Sequence[bytes], size: int) -> bytes:
    """Returns a run as a frame of its own, without a copy in between; `size`: the bytes of all rows, as many as fit."""
    array = _array_of(len(rows))
    return b"".join((_FRAME_OF_ONE.pack(1 + len(head) + len(array) + size, 0x91), head, array, *rows))


def _array_of(count: int) -> bytes:
    return _ARRAYS[count] if count < 16 else b"\xdc" + count.to_bytes(2, "big")


# Receiving -------------------------------------------------------------------------------------------------------


def messages_from_payload(payload: bytes | memoryview) -> list[Run | LinkMessage]:
    """Takes a frame's payload apart; what is in a run is decoded by `packets_of`.

    Raises:
        RemoteProtocolError: it is not an array of messages, or a message is malformed.
    """
    try:
        return _FRAME.decode(payload)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise RemoteProtocolError(f"a frame is malformed: {error}") from None


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


class RunReader:
    """Reads the frames of one link that hold one run each, with the same head as the one before.

    Nearly all frames of a busy link do, and those of a dialogue. Only their rows are decoded: a packet that comes alone
    takes 1.3 µs, where the frame, the head and the rows one after the other take 2.0.
    """

    __slots__ = ("_head", "_start")

    def __init__(self) -> None:
        self._start = b""
        self._head: Run | None = None

    def read(self, payload: memoryview) -> tuple[list[Packet], int] | None:
        """Returns the packets of such a frame, and their bytes; None of any other.

        Raises:
            RemoteProtocolError: as `packets_of`.
        """
        start, head = self._start, self._head
        if head is None or payload[: len(start)] != start:
            return None
        rows = payload[len(start) :]
        return _packets(head, rows), len(rows)

    def remember(self, payload: memoryview, run: Run) -> None:
        """Notes the head of the only run of a payload that was not such a frame."""
        self._start = bytes(payload[: len(payload) - memoryview(run.rows).nbytes])
        # Without its rows, which would keep the memory of all that was read with them.
        self._head = Run(run.channel, run.kind, run.source, run.destination, _NO_ROWS)


def packets_of(run: Run) -> list[Packet]:
    """Returns the packets of a run; their bodies become the registered class.

    Raises:
        RemoteProtocolError: they are malformed, or a body does not fit its type.
    """
    return _packets(run, run.rows)


def _packets(head: Run, encoded: memoryview | msgspec.Raw) -> list[Packet]:
    channel, kind, source, destination = head.channel, head.kind, head.source, head.destination
    cls = body_class(kind)
    decoder = _DECODERS[cls] if cls in _DECODERS else _decoder(cls)
    if decoder is None:
        rows = _checked_rows(head, encoded)
    else:
        try:
            rows = decoder.decode(encoded)
        except msgspec.DecodeError as error:
            raise RemoteProtocolError(f"a packet of the type {kind!r} from {source} is malformed: {error}") from None
        except Exception as error:  # a registered class may run code of its own in __post_init__
            raise RemoteProtocolError(
                f"a packet of the type {kind!r} from {source} has a bad body: {type(error).__name__}: {error}"
            ) from None
    return [
        Packet(channel, kind, source, destination, stamp, seq, body, cause, fence)
        for stamp, seq, cause, body, fence in rows
    ]


def _checked_rows(head: Run, encoded: memoryview | msgspec.Raw) -> list[_Row]:
    """Decodes rows whose bodies may hold anything: with a look at each part of them."""
    try:
        rows = msgspec.convert(unpacked(encoded), Annotated[list[_Row], msgspec.Meta(min_length=1)])
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(
            f"a packet of the type {head.kind!r} from {head.source} is malformed: {error}"
        ) from None
    return [
        (stamp, seq, cause, received_body(head.kind, body, head.source), fence)
        for stamp, seq, cause, body, fence in rows
    ]


def _decoder(cls: type | None) -> _Rows | None:
    """Returns what decodes rows with a body of this class in one go; None where their bodies must be looked at."""
    if cls is None:
        return None
    made = None
    if _is_closed(inspect.type_info(cls), ()):
        row = tuple[Stamp, Seq, _Cause, cls, Fence | None]  # type: ignore[valid-type]
        made = msgspec.msgpack.Decoder(Annotated[list[row], msgspec.Meta(min_length=1)])
    _DECODERS[cls] = made
    return made


_SCALARS: Final = (
    inspect.NoneType,
    inspect.BoolType,
    inspect.IntType,
    inspect.FloatType,
    inspect.StrType,
    inspect.BytesType,
    inspect.EnumType,
    inspect.LiteralType,
)


def _is_closed(info: inspect.Type, within: tuple[type, ...]) -> bool:
    """Returns whether a value of a type holds nothing but what its type says, to a depth that the type sets.

    Where a type leaves something open, what comes may be nested deeper than is good, or hold an extension type.
    """
    match info:
        case inspect.Metadata(inner):
            return _is_closed(inner, within)
        case inspect.UnionType(types):
            return all(_is_closed(it, within) for it in types)
        case inspect.ListType(item) | inspect.VarTupleType(item):
            return _is_closed(item, within)
        case inspect.TupleType(items):
            return all(_is_closed(it, within) for it in items)
        case inspect.DictType(key, value):
            return isinstance(key, inspect.StrType) and _is_closed(value, within)
        case inspect.DataclassType(cls, fields) | inspect.StructType(cls, fields):
            return cls not in within and all(_is_closed(it.type, (*within, cls)) for it in fields)
    return isinstance(info, _SCALARS)
