"""Encode and decode msgpack and JSON, and digest bytes; all of Pancakes uses these functions, not msgspec's own.

Two faults of msgspec (0.22) can crash the process without a message. This module prevents both:

* msgspec stores what it knows of a class in that class, before this information is complete. If another thread decodes
  the class meanwhile, it follows pointers that are not set. So all decoders and type infos are built under one lock.
  A part of it is msgspec's issue 744; the crash is not reported.
* If memory runs out while `Encoder.encode` grows its output, msgspec frees the output twice. `encode_into` raises
  MemoryError instead. msgspec's JSON decoder does not check whether it got memory for a text, so long JSON is read by
  Python's own decoder.

pyproject.toml forbids msgspec's functions elsewhere. `MALFORMED` lists all errors that decoding can raise. `sha256`
and `blake2s` do without OpenSSL, whose import costs megabytes. docs/architecture.md describes how the faults were
found.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, TypeVar, overload

import msgspec
from msgspec import inspect


def plain_of(text: bytes | str) -> Any:
    """Decode JSON to plain values.

    Raises:
        ValueError: it is not JSON, is nested thousands deep, or has a number of thousands of digits.
    """
    import json  # takes 2 ms of a start

    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


MALFORMED: Final = (msgspec.DecodeError, RecursionError, UnicodeError)
"""The errors of msgspec's decoders. `RecursionError`: the data is nested thousands deep."""


def why_malformed(error: Exception) -> str:
    """Return what is wrong with the bytes, for the end of a sentence."""
    return "it is nested too deep" if isinstance(error, RecursionError) else str(error)


try:
    from _blake2 import blake2s as _own_blake2s
except ImportError:  # a Python without its own
    from hashlib import blake2s as _own_blake2s

blake2s: Final = _own_blake2s
"""The hash with a key, without OpenSSL."""

try:
    from _sha256 import sha256 as _own_sha256  # type: ignore[import-not-found] # Python 3.11
except ImportError:
    try:
        from _sha2 import sha256 as _own_sha256  # type: ignore[import-not-found] # from Python 3.12 on
    except ImportError:
        from hashlib import sha256 as _own_sha256

LONG_BYTES: Final = 256 * 1024
"""From this length on OpenSSL computes the digest."""


def sha256(data: bytes) -> bytes:
    """Return the digest, 32 bytes."""
    if len(data) < LONG_BYTES:
        digest: bytes = _own_sha256(data).digest()
        return digest
    import hashlib

    return hashlib.sha256(data).digest()


UNENCODABLE: Final = (TypeError, ValueError, OverflowError, RuntimeError, MemoryError, msgspec.MsgspecError)
"""The errors of encoding. `RuntimeError`: nested too deep, or a mapping was changed meanwhile."""
LONG_JSON_BYTES: Final = 64 * 1024
"""Longer JSON is read by Python's own decoder, which is slower and survives a lack of memory."""

_T = TypeVar("_T")

_LOCK: Final = threading.RLock()  # reentrant: a type may run its own code when it is resolved
_BUILT: Final[set[type]] = set()
_MSGPACK: Final = msgspec.msgpack.Encoder()


@overload
def decoder(kind: type[_T], extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], _T]: ...


@overload
def decoder(kind: Any, extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], Any]: ...


def decoder(kind: Any, extension: Callable[[int, memoryview], Any] | None = None) -> Callable[[Any], Any]:
    """Return a decoder of msgpack to a type. Keep it, because making one takes long. Any thread.

    Args:
        kind: the type.
        extension: makes a value from the number and the bytes of a msgpack extension type; None: no extensions.

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
    """Return a decoder of JSON to a type; see `decoder`.

    It raises the errors in `MALFORMED`.
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
    """Convert plain values to a type. Any thread.

    Args:
        value: the plain values.
        kind: the type.
        hook: makes an instance of a type that msgspec does not know, from the type and a plain value; with one, the
            keys of mappings may be texts that stand for numbers.

    Raises:
        msgspec.ValidationError: they do not fit.
        TypeError: msgspec cannot make such a type.
    """
    if not (isinstance(kind, type) and kind in _BUILT):
        _build(kind)
    return msgspec.convert(value, kind, str_keys=hook is not None, dec_hook=hook)


def converter(kind: Any) -> Callable[[Any], Any]:
    """Return `convert` for a type that is not a class and is used often: it is analysed only once."""
    _build(kind)
    return partial(msgspec.convert, type=kind)


def type_info(kind: Any) -> inspect.Type:
    """Return msgspec's information on a type; see `convert` for the errors."""
    with _LOCK:
        return inspect.type_info(kind)


def schema_components(
    cls: type, ref_template: str, hook: Callable[[type], dict[str, Any]] | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the JSON Schema of a class, and those of the classes in it, see `msgspec.json.schema_components`."""
    with _LOCK:
        (schema,), components = msgspec.json.schema_components((cls,), schema_hook=hook, ref_template=ref_template)
    return schema, components


def _build(kind: Any) -> None:
    with _LOCK:
        msgspec.msgpack.Decoder(kind)
        if isinstance(kind, type):  # others may be equal but not identical, and msgspec marks only one
            _BUILT.add(kind)


# Encoding --------------------------------------------------------------------------------------------------------


_FIRST_BYTES: Final = 256
"""The first size of a buffer: nearly all values fit."""
_ENCODE_INTO: Final = _MSGPACK.encode_into


def _grown(encode_into: Callable[[Any, bytearray], None], value: Any) -> bytes:
    buffer = bytearray(_FIRST_BYTES)
    try:
        encode_into(value, buffer)
        return bytes(buffer)
    except MemoryError:
        raise MemoryError(_NO_MEMORY) from None


_NO_MEMORY: Final = "there is no memory left to encode it"


encode_small: Final = _MSGPACK.encode
"""Encodes a value that is certainly small as msgpack, in half the time of `encode`."""


def encode(value: Any) -> bytes:
    """Encode a value as msgpack. Any thread.

    Raises:
        UNENCODABLE: it cannot be encoded; the message of a MemoryError has the reason.
    """
    buffer = bytearray(_FIRST_BYTES)  # like `_grown`, in one call: each packet that leaves an agent is encoded here
    try:
        _ENCODE_INTO(value, buffer)
        return bytes(buffer)
    except MemoryError:
        raise MemoryError(_NO_MEMORY) from None


def encoder(hook: Callable[[Any], Any]) -> Callable[[Any], bytes]:
    """Return an encoder to msgpack; the hook converts values that msgspec does not know."""
    return partial(_grown, msgspec.msgpack.Encoder(enc_hook=hook).encode_into)


def unencodable_in(value: Any, encode: Callable[[Any], bytes]) -> tuple[str | int, ...]:
    """Return the path to the first plain value that cannot be encoded; empty: no single part is at fault."""
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
    """Return an encoder to JSON; the hook converts values that msgspec does not know."""
    return partial(_grown, msgspec.json.Encoder(enc_hook=hook).encode_into)


encode_json: Final = json_encoder()
"""Encodes a value as JSON; see `encode` for the errors."""
