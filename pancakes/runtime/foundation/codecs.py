"""What encodes and decodes, and what msgspec knows of a type: built under one lock. All of Pancakes uses these.

Two faults of msgspec (0.22) end a process without a word, and this module is what keeps them away:

* msgspec stores what it knows of a class with that class, and does so before it is complete. A thread that decodes the
  class meanwhile follows pointers that are not set. So one thread at a time builds, and nothing is decoded before.
  Part of it is msgspec's issue 744 (types are to be parsed safely in several threads); the crash is not reported.
* Where there is no memory for the growing output of `Encoder.encode`, msgspec frees it twice; `encode_into` raises
  MemoryError. And its JSON decoder does not look whether it got memory for a text. No issue of msgspec tells of these.

pyproject.toml forbids msgspec's own functions elsewhere. docs/architecture.md says how this was found.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, TypeVar, overload

import msgspec
from msgspec import inspect

from pancakes.runtime.foundation.json_text import plain_of

UNENCODABLE: Final = (TypeError, ValueError, OverflowError, RuntimeError, MemoryError, msgspec.MsgspecError)
"""All that encoding raises. `RuntimeError`: it is too deep, or a mapping that its owner changes meanwhile."""
LONG_JSON_BYTES: Final = 64 * 1024
"""JSON that is longer is read by Python's own decoder, which takes longer and survives a lack of memory."""

_T = TypeVar("_T")

_LOCK: Final = threading.RLock()  # again by one thread: a type may run code of its own where it is resolved
_BUILT: Final[set[type]] = set()
_MSGPACK: Final = msgspec.msgpack.Encoder()


@overload
def decoder(kind: type[_T], extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], _T]: ...


@overload
def decoder(kind: Any, extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], Any]: ...


def decoder(kind: Any, extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], Any]:
    """Returns what makes an instance of a type of msgpack; to be kept, because making it takes long. Any thread.

    Args:
        kind: the type.
        extension: makes a value of the number and the bytes of a msgpack extension type; None: there is none.

    Raises:
        TypeError: msgspec cannot decode such a type.
    """
    with _LOCK:
        return msgspec.msgpack.Decoder(kind, ext_hook=extension).decode


@overload
def json_decoder(kind: type[_T]) -> Callable[[bytes | str], _T]: ...


@overload
def json_decoder(kind: Any = Any) -> Callable[[bytes | str], Any]: ...


def json_decoder(kind: Any = Any) -> Callable[[bytes | str], Any]:
    """Returns what makes an instance of a type of JSON; see `decoder`.

    It raises what `pancakes.runtime.foundation.malformed` says.
    """
    with _LOCK:
        decode: Callable[[bytes | str], Any] = msgspec.json.Decoder(kind).decode

    def decode_any(data: bytes | str) -> Any:
        if len(data) <= LONG_JSON_BYTES:
            return decode(data)
        try:
            plain = plain_of(data)
        except ValueError as error:
            raise msgspec.DecodeError(f"JSON is malformed: {error}") from None
        return msgspec.convert(plain, kind, str_keys=True)

    return decode_any


@overload
def convert(value: Any, kind: type[_T], hook: Callable[[Any, Any], Any] | None = None) -> _T: ...


@overload
def convert(value: Any, kind: Any, hook: Callable[[Any, Any], Any] | None = None) -> Any: ...


def convert(value: Any, kind: Any, hook: Callable[[Any, Any], Any] | None = None) -> Any:
    """Makes an instance of a type of plain values. Any thread.

    Args:
        value: the plain values.
        kind: the type.
        hook: makes an instance of a type that msgspec does not know, of that type and a plain value; with one, the
            keys of mappings may be texts that stand for numbers.

    Raises:
        msgspec.ValidationError: they do not fit.
        TypeError: msgspec cannot make such a type.
    """
    if not (isinstance(kind, type) and kind in _BUILT):
        _build(kind)
    return msgspec.convert(value, kind, str_keys=hook is not None, dec_hook=hook)


def converter(kind: Any) -> Callable[[Any], Any]:
    """Returns `convert` for a type that is no class and is met often: it is looked at now, and never again."""
    _build(kind)
    return partial(msgspec.convert, type=kind)


def type_info(kind: Any) -> inspect.Type:
    """Returns what msgspec knows of a type; see `convert` for the errors."""
    with _LOCK:
        return inspect.type_info(kind)


def schema_components(
    cls: type, ref_template: str, hook: Callable[[type], dict[str, Any]] | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the JSON Schema of a class, and those of the classes in it, see `msgspec.json.schema_components`."""
    with _LOCK:
        (schema,), components = msgspec.json.schema_components((cls,), schema_hook=hook, ref_template=ref_template)
    return schema, components


def _build(kind: Any) -> None:
    with _LOCK:
        msgspec.msgpack.Decoder(kind)
        if isinstance(kind, type):  # other types may be equal and not the same, and msgspec notes it with the one
            _BUILT.add(kind)


# Encoding --------------------------------------------------------------------------------------------------------


def _grown(encode_into: Callable[[Any, bytearray], None], value: Any) -> bytes:
    buffer = bytearray()
    try:
        encode_into(value, buffer)
        return bytes(buffer)
    except MemoryError:
        raise MemoryError("there is no memory left to encode it") from None


encode_small: Final = _MSGPACK.encode
"""Encodes what is sure to be small as msgpack, in half the time that `encode` takes."""


def encode(value: Any) -> bytes:
    """Encodes a value as msgpack. Any thread.

    Raises:
        UNENCODABLE: it cannot be encoded; a MemoryError says in its sentence that there is no memory for it.
    """
    return _grown(_MSGPACK.encode_into, value)


def encoder(hook: Callable[[Any], Any]) -> Callable[[Any], bytes]:
    """Returns what encodes a value as msgpack; the hook makes values that msgspec knows of those that it does not."""
    return partial(_grown, msgspec.msgpack.Encoder(enc_hook=hook).encode_into)


def unencodable_in(value: Any, encode: Callable[[Any], bytes]) -> tuple[str | int, ...]:
    """Returns where in plain values the first one is that cannot be encoded; empty: no part of it alone is at fault."""
    if not isinstance(value, (Mapping, list, tuple)):
        return ()
    parts = value.items() if isinstance(value, Mapping) else enumerate(value)
    for key, part in parts:
        try:
            encode(part)
        except UNENCODABLE:
            return (key, *unencodable_in(part, encode))
    return ()


def json_encoder(hook: Callable[[Any], Any] | None = None) -> Callable[[Any], bytes]:
    """Returns what encodes a value as JSON; the hook makes plain values of what msgspec does not know."""
    return partial(_grown, msgspec.json.Encoder(enc_hook=hook).encode_into)


encode_json: Final = json_encoder()
"""Encodes a value as JSON; see `encode` for the errors."""
