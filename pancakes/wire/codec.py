"""Packets and link messages to msgpack and back.

A packet travels as the array [channel, type, source, destination, stamp, seq, cause, body, fence]; a dataclass
as a map of its fields; a numpy array as the one extension type, which holds its dtype, shape and raw bytes.

The encoder refuses whatever the decoder at the other end would refuse, so that the mistake is an error at the
one who publishes and never costs a link. The decoder has every limit checked before memory is taken.
"""

from __future__ import annotations

import math
import re
import sys
from enum import Enum
from typing import Annotated, Any, Final

import msgpack
import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError, WireError
from pancakes.packet import Fence, Packet, body_from_plain, field_names, has_fields
from pancakes.wire.framing import MAX_MESSAGE_BYTES, MAX_PAYLOAD_BYTES
from pancakes.wire.messages import LinkMessage

MAX_DEPTH: Final = 32
"""How deep arrays and maps may be nested, the frame's own array and the packet's counted."""
MAX_ARRAY_LENGTH: Final = 65_536
MAX_MAP_LENGTH: Final = 4_096
ARRAY_EXTENSION: Final = 1
"""Number of the msgpack extension type that holds a numpy array."""

_BODY_DEPTH: Final = 3  # within the frame's array and the packet's
_LEAVES: Final = frozenset((str, int, float, bool, bytes, type(None)))
_STRINGS: Final = frozenset((str,))
_FIELDS: Final[dict[type, tuple[str, ...]]] = {}  # of the classes that were sent: asking for them each time is slow
_DTYPE = re.compile(r"\A(?:\|b1|\|[iu]1|[<>][iu][248]|[<>]f[248]|[<>]c(?:8|16))\Z")

_Text = Annotated[str, msgspec.Meta(max_length=256)]
_Word = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
_Count = Annotated[int, msgspec.Meta(ge=0)]
_Side = Annotated[int, msgspec.Meta(ge=0, le=2**31)]


class _PacketRow(msgspec.Struct, array_like=True, forbid_unknown_fields=True, gc=False):
    """The checks that a packet's array goes through (msgspec remembers those of a class, not those of a tuple)."""

    channel: _Word
    type: _Word
    source: _Word
    destination: _Text
    stamp: Annotated[float, msgspec.Meta(ge=0, le=1e15)]
    seq: _Count
    cause: tuple[_Text, _Count] | None
    body: Any
    fence: Fence | None


class _ArrayRow(msgspec.Struct, array_like=True, forbid_unknown_fields=True, gc=False):
    """What the extension type of numpy arrays holds."""

    dtype: str
    shape: Annotated[tuple[_Side, ...], msgspec.Meta(max_length=32)]
    raw: bytes


class Encoder:
    """Encodes packets and link messages. Holds a reused msgpack `Packer`: one encoder to a thread."""

    def __init__(self) -> None:
        self._packer = msgpack.Packer()

    def packet(self, packet: Packet) -> bytes:
        """Returns a packet as one message of a frame.

        Raises:
            LocalProtocolError: it holds what cannot travel, or is larger than a frame. The sentence names the packet.
        """
        try:
            row = [
                packet.channel,
                packet.type,
                packet.source,
                packet.destination,
                packet.stamp,
                packet.seq,
                packet.cause,
                _plain(packet.body, _BODY_DEPTH, "its body"),
                None if packet.fence is None else (packet.fence.task_id, packet.fence.epoch),
            ]
            message: bytes = self._packer.pack(row)
            if len(message) > MAX_MESSAGE_BYTES:
                raise LocalProtocolError(f"it takes {len(message)} bytes, and a frame holds {MAX_MESSAGE_BYTES}")
        except (WireError, OverflowError, UnicodeError, TypeError, ValueError) as error:
            raise LocalProtocolError(
                f"the packet {packet.seq} of the type {packet.type!r} from {packet.source} cannot be sent: {error}"
            ) from None
        return message

    def link_message(self, message: LinkMessage) -> bytes:
        """Returns a message of the link as one message of a frame."""
        packed: bytes = self._packer.pack(msgspec.to_builtins(message, builtin_types=(bytes,)))
        return packed


def rows_from_payload(payload: bytes) -> list[list[Any]]:
    """Takes a frame's payload apart into the arrays that are its messages, within the limits of memory.

    What is in a message is checked when it is made of its array.

    Raises:
        RemoteProtocolError: it is not a msgpack array of messages, or breaks a limit.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise RemoteProtocolError(f"a frame of {len(payload)} bytes is longer than {MAX_PAYLOAD_BYTES}")
    try:
        rows = msgpack.unpackb(
            payload,
            ext_hook=_array_from_extension,
            max_array_len=MAX_ARRAY_LENGTH,
            max_map_len=MAX_MAP_LENGTH,
            max_str_len=len(payload),
            max_bin_len=len(payload),
            max_ext_len=len(payload),
        )
    except (ValueError, TypeError, MemoryError) as error:
        raise RemoteProtocolError(f"a frame is not valid msgpack: {error or type(error).__name__}") from None
    if type(rows) is not list or not rows:
        raise RemoteProtocolError("a frame holds no array of messages")
    for row in rows:
        if type(row) is not list or not row or type(row[0]) not in (str, int):
            raise RemoteProtocolError("a frame holds a message that is neither a packet nor the link's own")
    return rows


def packet_from_row(row: list[Any]) -> Packet:
    """Makes a packet from the array that came in; its body becomes the registered dataclass.

    Raises:
        RemoteProtocolError: the array is no packet, or the body does not fit its type.
    """
    try:
        it = msgspec.convert(row, _PacketRow)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"a packet is malformed: {error}") from None
    if type(it.body) not in _LEAVES:  # of all the rest msgspec knows the types
        _check_received(it.body, _BODY_DEPTH)
    body = _typed_body(it.type, it.body, it.source)
    return Packet(it.channel, it.type, it.source, it.destination, it.stamp, it.seq, body, it.cause, it.fence)


def _typed_body(kind: str, body: Any, source: str) -> Any:
    try:
        return body_from_plain(kind, body)
    except RemoteProtocolError as error:
        raise RemoteProtocolError(f"{error} (from {source})") from None
    except Exception as error:  # a registered class may run code of its own in __post_init__
        raise RemoteProtocolError(
            f"a packet of the type {kind!r} from {source} has a bad body: {type(error).__name__}: {error}"
        ) from None


def _plain(value: Any, depth: int, where: str) -> Any:
    """Turns a body into what msgpack packs as it stands; `where` leads to `value` in an error."""
    kind = type(value)
    if kind in _LEAVES:
        return value
    names = _FIELDS.get(kind)
    if names is not None:
        _check_depth(depth, where)
        fields = {name: getattr(value, name) for name in names}
        if not _LEAVES.issuperset(map(type, fields.values())):
            for name, item in fields.items():
                fields[name] = _plain(item, depth + 1, f"{where}.{name}")
        return fields
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
        _FIELDS[type(value)] = field_names(type(value))
        return _plain(value, depth, where)
    if isinstance(value, msgspec.Struct):
        fields = {name: getattr(value, name) for name in value.__struct_fields__}
        return _plain(list(fields.values()) if value.__struct_config__.array_like else fields, depth, where)
    if isinstance(value, Enum):
        return _plain(value.value, depth, where)
    numpy = sys.modules.get("numpy")  # an array can only be there if numpy is
    if numpy is not None:
        if isinstance(value, numpy.ndarray):
            return _extension_from_array(value, where)
        if isinstance(value, numpy.generic) and value.dtype.kind in "biuf":
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


def _check_received(value: Any, depth: int) -> None:
    kind = type(value)
    if kind is dict:
        if not _STRINGS.issuperset(map(type, value)):
            raise RemoteProtocolError("a packet holds a map with a key that is no string")
        inner = value.values()
    elif kind is list:
        inner = value
    elif kind is msgpack.Timestamp:  # msgpack makes these by itself, before it asks for our types
        raise RemoteProtocolError("a packet holds an extension type that is not ours: -1")
    else:
        return  # one of our arrays
    if depth > MAX_DEPTH:
        raise RemoteProtocolError(f"a packet is nested deeper than {MAX_DEPTH}")
    if not _LEAVES.issuperset(map(type, inner)):
        for item in inner:
            if type(item) not in _LEAVES:
                _check_received(item, depth + 1)


def _extension_from_array(array: Any, where: str) -> msgpack.ExtType:
    dtype = array.dtype.str
    if not _DTYPE.match(dtype):
        raise LocalProtocolError(f"{where} is an array of {array.dtype}, and only numbers and booleans travel")
    return msgpack.ExtType(ARRAY_EXTENSION, msgpack.packb((dtype, array.shape, array.tobytes())))


def _array_from_extension(code: int, data: bytes) -> Any:
    """Makes a read-only numpy array; its memory is the frame's own bytes."""
    if code != ARRAY_EXTENSION:
        raise RemoteProtocolError(f"a frame holds an extension type that is not ours: {code}")
    limit = len(data)
    try:
        array = msgspec.convert(
            msgpack.unpackb(data, max_array_len=64, max_map_len=0, max_str_len=8, max_bin_len=limit, max_ext_len=0),
            _ArrayRow,
        )
    except (ValueError, TypeError) as error:  # msgspec's ValidationError is a ValueError
        raise RemoteProtocolError(f"a frame holds a malformed array: {error}") from None
    if not _DTYPE.match(array.dtype):
        raise RemoteProtocolError(f"a frame holds an array of {array.dtype!r}, and only numbers and booleans travel")
    if math.prod(array.shape) * int(array.dtype[2:]) != len(array.raw):
        raise RemoteProtocolError(f"a frame holds an array of the shape {array.shape} in {len(array.raw)} bytes")
    import numpy

    return numpy.frombuffer(array.raw, dtype=array.dtype).reshape(array.shape)
