"""Encode packets as bytes and decode them: bodies, frames, single packets, and runs of packets. Pure.

A frame is a 4-byte big-endian length and that many bytes of msgpack: an array of one or more messages.

A body travels as plain values. A dataclass or a msgspec structure becomes a map of its fields, a numpy array the one
extension type. A value that cannot travel is an error at its publisher. A body that does not fit its class costs only
that packet at the receiver, never the link: two agents may know a type from different versions of a plug-in.

Over a link, packets travel in runs, which state once what their packets have in common: the array [0, channel, type,
source, destination, fence, rows], each row the array [stamp, seq, cause, body]. In recordings and in letters to
tasks, a packet travels alone: [channel, type, source, destination, stamp, seq, cause, body, fence]. All limits are
checked before memory is taken.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from typing import Annotated, Any, Final

import msgpack
import msgspec
from msgspec import inspect

from pancakes.errors import LocalProtocolError, RemoteProtocolError, WireError, describe
from pancakes.kernel.payload_size import is_small
from pancakes.mesh.messages import HELLO_NUMBER, LinkMessage
from pancakes.packet import Cause, Fence, Packet, agent_of, body_class, body_from_plain, field_names, has_fields
from pancakes.util import codecs
from pancakes.util.arrays import array_from_extension, extension_from_array, is_array, is_number
from pancakes.util.codecs import MALFORMED, type_info, why_malformed

MAX_PAYLOAD_BYTES: Final = 256 * 1024
"""Longest payload of a frame."""
MAX_MESSAGE_BYTES: Final = MAX_PAYLOAD_BYTES - 5
"""Longest message that still fits a frame, behind the header of the frame's array."""

_LENGTH = struct.Struct(">I")


def frame(messages: Sequence[bytes]) -> bytes:
    """Return encoded messages as one or more frames, as few as the limits allow.

    Raises:
        LocalProtocolError: a message does not fit a frame.
    """
    if len(messages) == 1 and (size := len(messages[0])) <= MAX_MESSAGE_BYTES:  # most frames of a dialogue
        return _LENGTH.pack(size + 1) + b"\x91" + messages[0]
    parts: list[bytes] = []
    start = length = 0
    for index, message in enumerate(messages):
        if len(message) > MAX_MESSAGE_BYTES:
            raise LocalProtocolError(f"a message of {len(message)} bytes does not fit a frame ({MAX_MESSAGE_BYTES})")
        if length + len(message) > MAX_MESSAGE_BYTES or index - start == 65_535:
            _one_frame(messages[start:index], length, parts)
            start, length = index, 0
        length += len(message)
    if start < len(messages):
        _one_frame(messages[start:], length, parts)
    return b"".join(parts)


def array_head(count: int) -> bytes:
    """Return the header of a msgpack array of up to 65,535 items."""
    return bytes((0x90 | count,)) if count < 16 else b"\xdc" + count.to_bytes(2, "big")


def _one_frame(messages: Sequence[bytes], length: int, parts: list[bytes]) -> None:
    header = array_head(len(messages))
    parts.append(_LENGTH.pack(len(header) + length))
    parts.append(header)
    parts.extend(messages)


class FrameReader:
    """Cut the bytes of one connection into payloads, whatever pieces the network delivers."""

    def __init__(self) -> None:
        self._rest = b""
        self._missing = 0  # bytes that `_rest` lacks for a whole frame
        self._chunks: list[bytes] = []

    def feed(self, data: bytes) -> list[memoryview]:
        """Take bytes that came in.

        Returns:
            The payloads that are now complete, in order: views, not copies.

        Raises:
            RemoteProtocolError: a length of 0 or above the limit was announced. No memory was taken for it; the reader
                cannot be used any more.
        """
        if not self._rest and len(data) > 4 and _LENGTH.unpack_from(data)[0] == len(data) - 4 <= MAX_PAYLOAD_BYTES:
            return [memoryview(data)[4:]]  # one whole frame, as most that come
        if self._missing > len(data):  # a long frame comes in many pieces: join them once, not at each piece
            self._chunks.append(data)
            self._missing -= len(data)
            return []
        if self._chunks or self._rest:
            data = b"".join((self._rest, *self._chunks, data))
            self._chunks.clear()
        payloads: list[memoryview] = []
        position, end = 0, len(data)
        view = memoryview(data)
        self._missing = 0
        while end - position >= 4:
            (length,) = _LENGTH.unpack_from(data, position)
            if not 1 <= length <= MAX_PAYLOAD_BYTES:
                raise RemoteProtocolError(f"a frame of {length} bytes was announced; 1 to {MAX_PAYLOAD_BYTES} may be")
            if end - position - 4 < length:
                self._missing = length - (end - position - 4)
                break
            payloads.append(view[position + 4 : position + 4 + length])
            position += 4 + length
        self._rest = data[position:]
        return payloads


MAX_DEPTH: Final = 32
"""How deep arrays and maps may be nested, including the two levels around the body."""
MAX_ARRAY_LENGTH: Final = 65_536
MAX_MAP_LENGTH: Final = 4_096

BODY_DEPTH: Final = 3
"""The level of a body."""

_LEAVES: Final = frozenset((str, int, float, bool, bytes, type(None)))
_STRINGS: Final = frozenset((str,))


def encodable(body: Any) -> Any:
    """Return a body in a form that msgspec can encode: plain values, shared with the body where possible.

    Raises:
        LocalProtocolError: a part of it cannot be encoded; the sentence says where.
    """
    return _plain(body, BODY_DEPTH, "its body")


def _plain(value: Any, depth: int, where: str) -> Any:
    """Turn a body into plain values; `where` names `value` in an error."""
    kind = type(value)
    if kind in _LEAVES:
        return value
    if kind is dict:
        _check_depth(depth, where)
        if len(value) > MAX_MAP_LENGTH:
            raise LocalProtocolError(f"{where} is a map of {len(value)}, and {MAX_MAP_LENGTH} is the most")
        if not _STRINGS.issuperset(map(type, value)):
            return _plain({_key(key, where): item for key, item in value.items()}, depth, where)
        if _LEAVES.issuperset(map(type, value.values())):
            return value
        return {key: _plain(item, depth + 1, f"{where}.{key}") for key, item in value.items()}
    if kind is list or kind is tuple:
        _check_depth(depth, where)
        if len(value) > MAX_ARRAY_LENGTH:
            raise LocalProtocolError(f"{where} is a list of {len(value)}, and {MAX_ARRAY_LENGTH} is the most")
        if _LEAVES.issuperset(map(type, value)):
            return value
        return [_plain(item, depth + 1, f"{where}[{index}]") for index, item in enumerate(value)]
    return _plain_object(value, depth, where)


def _plain_object(value: Any, depth: int, where: str) -> Any:
    if has_fields(type(value)):
        return _plain({name: getattr(value, name) for name in field_names(type(value))}, depth, where)
    if isinstance(value, msgspec.Struct):
        items = {name: getattr(value, name) for name in value.__struct_fields__}
        return _plain(list(items.values()) if value.__struct_config__.array_like else items, depth, where)
    if isinstance(value, Enum):
        return _plain(value.value, depth, where)
    if is_array(value):
        return extension_from_array(value, where)
    if is_number(value):
        return value.item()
    if isinstance(value, dict):
        return _plain(dict(value), depth, where)
    if isinstance(value, (list, tuple)) and not isinstance(value, msgpack.ExtType):  # a named tuple, say
        return _plain(list(value), depth, where)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value)
    raise LocalProtocolError(f"{where} is of the type {type(value).__name__}, which does not travel")


def _key(key: Any, where: str) -> str:
    if isinstance(key, Enum):
        key = key.value
    if not isinstance(key, str):
        raise LocalProtocolError(f"{where} has the key {key!r}, and keys must be strings")
    return str(key)


def _check_depth(depth: int, where: str) -> None:
    if depth > MAX_DEPTH:
        raise LocalProtocolError(f"{where[:80]} is nested deeper than {MAX_DEPTH}")


# What came in --------------------------------------------------------------------------------------------------


def unpacked(data: bytes | memoryview | msgspec.Raw) -> Any:
    """Decode any msgpack, within the limits on memory.

    Raises:
        RemoteProtocolError: it is not msgpack, or breaks a limit.
    """
    length = memoryview(data).nbytes
    try:
        return msgpack.unpackb(
            data,
            ext_hook=array_from_extension,
            max_array_len=MAX_ARRAY_LENGTH,
            max_map_len=MAX_MAP_LENGTH,
            max_str_len=length,
            max_bin_len=length,
            max_ext_len=length,
        )
    except (ValueError, TypeError, MemoryError) as error:
        raise RemoteProtocolError(f"a frame is not valid msgpack: {error or type(error).__name__}") from None


def received_body(kind: str, plain: Any, source: str) -> Any:
    """Make the body of a packet of the type `kind` from decoded values; if the type is unknown, it stays plain.

    Raises:
        RemoteProtocolError: a part of it is not allowed in a packet, or it does not fit its type.
    """
    if type(plain) not in _LEAVES:
        _check_received(plain, BODY_DEPTH)
    try:
        return body_from_plain(kind, plain)
    except RemoteProtocolError as error:
        raise RemoteProtocolError(f"{error} (from {source})") from None
    except Exception as error:  # a registered class may run code of its own in __post_init__
        raise RemoteProtocolError(
            f"a packet of the type {kind!r} from {source} has a bad body: {type(error).__name__}: {error}"
        ) from None


def _check_received(value: Any, depth: int) -> None:
    kind = type(value)
    if kind is dict:
        if not _STRINGS.issuperset(map(type, value)):
            raise RemoteProtocolError("a packet has a map with a key that is not a string")
        inner = value.values()
    elif kind is list:
        inner = value
    elif kind is msgpack.Timestamp:  # msgpack makes these by itself, before it asks for our types
        raise RemoteProtocolError("a packet has an extension type that is not ours: -1")
    else:
        return  # one of our arrays
    if depth > MAX_DEPTH:
        raise RemoteProtocolError(f"a packet is nested deeper than {MAX_DEPTH}")
    if not _LEAVES.issuperset(map(type, inner)):
        for item in inner:
            if type(item) not in _LEAVES:
                _check_received(item, depth + 1)


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


@lru_cache(maxsize=4096)
def is_closed(cls: type) -> bool:
    """Return whether the class fixes all that an instance can contain, and all of that can be encoded."""
    try:
        return _is_closed(type_info(cls), ())
    except Exception:  # its annotations cannot be read
        return False


def _is_closed(info: inspect.Type, within: tuple[type, ...]) -> bool:
    """Return whether a type fixes all that a value can contain, to a bounded depth.

    If a type leaves something open, a value may be nested too deep, or contain an extension type.
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
        case inspect.NamedTupleType(cls, parts):
            return cls not in within and all(_is_closed(it.type, (*within, cls)) for it in parts)
        case inspect.DataclassType(cls, parts) | inspect.StructType(cls, parts):
            return (
                cls not in within and _is_sent_whole(cls) and all(_is_closed(it.type, (*within, cls)) for it in parts)
            )
    return isinstance(info, _SCALARS)


def _is_sent_whole(cls: type) -> bool:
    if issubclass(cls, msgspec.Struct):
        return not cls.__struct_config__.omit_defaults
    # msgspec leaves out a field that no instance has for itself.
    return is_dataclass(cls) and all(field.init for field in fields(cls))


Text = Annotated[str, msgspec.Meta(max_length=256)]
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
Stamp = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Seq = Annotated[int, msgspec.Meta(ge=0)]


_PARTS: Final = codecs.decoder(list[msgspec.Raw])
_TEXT: Final = codecs.decoder(str)
_NUMBER: Final = codecs.decoder(float)
_SOURCE: Final = 2
_STAMP: Final = 4
"""The index of the source in the array."""


class _PacketRow(msgspec.Struct, array_like=True, forbid_unknown_fields=True, gc=False):
    """The checks of a packet's array (msgspec caches the decoder of a class, not that of a tuple)."""

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
    """Return the error for a packet that cannot be sent, with the reason."""
    why = str(error) if isinstance(error, (WireError, *codecs.UNENCODABLE)) else describe(error)
    return LocalProtocolError(
        f"the packet {packet.number} of the type {packet.type!r} from {packet.source} cannot be sent: {why}"
    )


def encode_packet(packet: Packet) -> bytes:
    """Encode a packet that is not part of a run, as msgpack.

    Raises:
        LocalProtocolError: a part of it cannot be encoded, or it is larger than a frame. The sentence names the packet.
    """
    try:
        body = encodable(packet.body)
        message = codecs.encode(
            (
                packet.channel,
                packet.type,
                packet.source,
                packet.destination,
                packet.stamp_s,
                packet.seq,
                packet.cause,
                body,
                packet.fence,
            )
        )
        if len(message) > MAX_MESSAGE_BYTES:
            raise LocalProtocolError(f"it takes {len(message)} bytes, and a frame has room for {MAX_MESSAGE_BYTES}")
    except Exception as error:  # a body may run its own code when it is encoded
        raise unsendable(packet, error) from None
    return message


def encode_link_message(message: LinkMessage) -> bytes:
    """Encode a message of the link as one message of a frame."""
    return codecs.encode_small(message)


def of_agent(packet: bytes, agent: str, restamped: Callable[[str, float], float]) -> bytes:
    """Return an encoded packet as one from another agent, to which its source has migrated.

    Bytes that are not a packet are returned unchanged.

    Args:
        packet: the packet, as `encode_packet` made it.
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
    """Decode an array of packets, each as `encode_packet` made it, within the limits on memory.

    The contents of a packet are checked later, in `packet_from_row`.

    Raises:
        RemoteProtocolError: it is not a msgpack array of arrays, or breaks a limit.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise RemoteProtocolError(f"a frame of {len(payload)} bytes is longer than {MAX_PAYLOAD_BYTES}")
    rows = unpacked(payload)
    if type(rows) is not list or not rows:
        raise RemoteProtocolError("a frame is not an array of messages")
    for row in rows:
        if type(row) is not list or not row or type(row[0]) not in (str, int):
            raise RemoteProtocolError("a frame has a message that is neither a packet nor the link's own")
    return rows


def packet_from_row(row: list[Any]) -> Packet:
    """Make a packet from a decoded array; its body becomes an instance of the registered class.

    Raises:
        RemoteProtocolError: the array is not a packet, or the body does not fit its type.
    """
    try:
        it = codecs.convert(row, _PacketRow)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"a packet is malformed: {error}") from None
    body = received_body(it.type, it.body, it.source)
    return Packet(it.channel, it.type, it.source, it.destination, it.stamp, it.seq, body, it.cause, it.fence)


LONGEST_REASON: Final = 1000
"""Longest reason given for a bad body: it may quote text that the peer made up."""
_ROOM: Final = MAX_MESSAGE_BYTES - 3  # for a head and its rows, after the longest header of the array of rows

_HEAD_LENGTH: Final = 7


class PacketRun(msgspec.Struct, array_like=True, tag=0, frozen=True, forbid_unknown_fields=True):
    """Packets with the same source, destination, type, channel and fence, in their order.

    Attributes:
        channel: see `Packet`.
        kind: their type.
        source: see `Packet`.
        destination: see `Packet`.
        fence: see `Packet`.
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
    """A received packet whose body does not fit its type or is not allowed in a packet: no subscriber gets it.

    Attributes:
        packet: the packet, with None for a body.
        reason: a sentence that names it.
    """

    packet: Packet
    reason: str


class _Nobody:
    """A class that no body has."""


# Sending ---------------------------------------------------------------------------------------------------------


def head_of(packet: Packet) -> bytes:
    """Return the head of all runs with this packet's channel, type, source, destination and fence.

    Raises:
        LocalProtocolError: it cannot be encoded.
    """
    words = (packet.channel, packet.type, packet.source, packet.destination)
    try:
        if not all(words[:3]) or max(map(len, words)) > 256:
            raise LocalProtocolError("its channel, type, source or destination has not 1 to 256 characters")
        return bytes((0x90 | _HEAD_LENGTH, 0)) + b"".join(map(codecs.encode_small, (*words, packet.fence)))
    except (WireError, UnicodeError) as error:
        raise unsendable(packet, error) from None


class RowEncoder:
    """Encode packets as rows of runs that begin with `head`, which all these packets share. Any thread.

    Attributes:
        most: the largest size of a row, in bytes.
    """

    __slots__ = ("_known", "most")

    def __init__(self, head: bytes) -> None:
        self.most = _ROOM - len(head)
        # The class of the last body, and how its bodies are encoded: one value, because other threads change it too.
        self._known: tuple[type, bool, Callable[[Any], bytes]] = (_Nobody, True, codecs.encode)

    def encode(self, packet: Packet) -> bytes:
        """Encode a packet as a row.

        Raises:
            LocalProtocolError: a part of it cannot be encoded, or it is larger than a frame. The error names the
                packet.
        """
        body = packet.body
        try:
            cls, is_open, encode = self._known
            if type(body) is not cls:
                _, is_open, encode = self._known = _how_encoded(type(body))
            if is_open:
                body = encodable(body)
            try:
                row = encode((packet.stamp_s, packet.seq, packet.cause, body))
            except TypeError:  # such as a numpy number in a field for a plain number
                row = encode((packet.stamp_s, packet.seq, packet.cause, encodable(body)))
            if len(row) > self.most:
                raise LocalProtocolError(
                    f"it takes {_ROOM - self.most + len(row)} bytes, and a frame has room for {_ROOM}"
                )
        except Exception as error:  # as in `encode_packet`
            raise unsendable(packet, error) from None
        return row


def _how_encoded(cls: type) -> tuple[type, bool, Callable[[Any], bytes]]:
    """Return the class, whether its instances must be checked before they are encoded, and their encoder."""
    is_open = not is_closed(cls)
    return cls, is_open, codecs.encode_small if not is_open and is_small(cls) else codecs.encode


def run_of(head: bytes, rows: Sequence[bytes]) -> bytes:
    """Return a run of up to 65,535 rows as one message of a frame."""
    return b"".join((head, array_head(len(rows)), *rows))


# Receiving -------------------------------------------------------------------------------------------------------


def messages_from_payload(payload: bytes | memoryview) -> list[PacketRun | LinkMessage]:
    """Decode a frame's payload; the packets in a run are decoded by `packets_of`.

    Raises:
        RemoteProtocolError: it is not an array of messages, or a message is malformed.
    """
    try:
        return _FRAME(payload)
    except MALFORMED as error:
        raise RemoteProtocolError(f"a frame is malformed: {why_malformed(error)}") from None


def foreign_version(payload: bytes | memoryview, own: int) -> object:
    """Return the version in the hello of a payload if it is not ours; None in any other case.

    After the version, the hello of another version may have any form.
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
    """Decode the packets of a run. Return those whose bodies fit their registered class, and the unfit ones.

    Raises:
        RemoteProtocolError: they are malformed.
    """
    channel, kind, source, destination, fence = run.channel, run.kind, run.source, run.destination, run.fence
    cls = body_class(kind)
    decoder = _DECODERS[cls] if cls in _DECODERS else _decoder(cls)
    try:
        rows = decoder(run.rows) if decoder is not None else _checked_rows(run)
    except Exception:  # also from a registered class, which may run its own code in __post_init__
        return _one_by_one(run)
    return [
        Packet(channel, kind, source, destination, stamp, seq, body, cause, fence) for stamp, seq, cause, body in rows
    ], ()


def _checked_rows(run: PacketRun) -> list[_Row]:
    """Decode rows whose bodies may contain anything: each part is checked."""
    rows = _SOME_ROWS(unpacked(run.rows))
    kind, source = run.kind, run.source
    return [(stamp, seq, cause, received_body(kind, body, source)) for stamp, seq, cause, body in rows]


def _one_by_one(run: PacketRun) -> tuple[list[Packet], list[Unfit]]:
    """Decode rows one at a time, because at least one of them is bad."""
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
    """Return a sentence that names the packets with this faulty body."""
    text = str(error)[:LONGEST_REASON]
    return text if text.endswith(f"(from {source})") else f"a packet of the type {kind!r} from {source}: {text}"


def _decoder(cls: type | None) -> _Rows | None:
    """Return the decoder of rows with bodies of this class; None if their bodies must be checked part by part."""
    if cls is None:
        return None
    made: _Rows | None = None
    if is_closed(cls):
        row = tuple[Stamp, Seq, _Cause, cls]  # type: ignore[valid-type]
        made = codecs.decoder(Annotated[list[row], msgspec.Meta(min_length=1)])
    _DECODERS[cls] = made
    return made
