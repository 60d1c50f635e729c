"""What the body of a packet may contain, and what it becomes on the wire.

A value that cannot travel is an error at its publisher. A body that does not fit its class costs that packet, where it
arrives. A dataclass, or a structure of msgspec's, travels as a map of its fields; a numpy array as the one
extension type (`pancakes.runtime.foundation.arrays`).
"""

from __future__ import annotations

from enum import Enum
from typing import Any, Final

import msgpack
import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.packet import body_from_plain, field_names, has_fields
from pancakes.runtime.foundation.arrays import array_from_extension, extension_from_array, is_array, is_number

MAX_DEPTH: Final = 32
"""How deep arrays and maps may be nested, two levels round the body counted."""
MAX_ARRAY_LENGTH: Final = 65_536
MAX_MAP_LENGTH: Final = 4_096

BODY_DEPTH: Final = 3
"""The level at which a body stands."""

_LEAVES: Final = frozenset((str, int, float, bool, bytes, type(None)))
_STRINGS: Final = frozenset((str,))


def encodable(body: Any) -> Any:
    """Returns a body as msgspec may encode it: plain values, which are parts of it where they can be.

    Raises:
        LocalProtocolError: a part of it does not travel; the sentence says where.
    """
    return _plain(body, BODY_DEPTH, "its body")


def _plain(value: Any, depth: int, where: str) -> Any:
    """Turns a body into what is encoded as it stands; `where` leads to `value` in an error."""
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
    """Takes msgpack of any form apart, within the limits of memory.

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
    """Makes the body of a packet of the type `kind` from what came in; where the type is unknown it stays plain.

    Raises:
        RemoteProtocolError: a part of it may not be in a packet, or it does not fit its type.
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
            raise RemoteProtocolError("a packet has a map with a key that is no string")
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
