"""Handle numpy arrays in packet bodies, settings and state: encode, check, convert and compare them.

Nothing here imports numpy by itself, because most agents do not need it. A value that is an array has imported it.
"""

from __future__ import annotations

import math
import re
import sys
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, get_args, get_origin

import msgpack
import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.util import codecs

ARRAY_EXTENSION: Final = 1
"""The number of the msgpack extension type of a numpy array: its dtype, shape and raw bytes."""

_DTYPE = re.compile(r"\A(?:\|b1|\|[iu]1|[<>][iu][248]|[<>]f[248]|[<>]c(?:8|16))\Z")

_ALIAS: Final[Any] = getattr(typing, "TypeAliasType", ())
"""The type of `type X = ...`; none before Python 3.12."""

_Side = Annotated[int, msgspec.Meta(ge=0, le=2**31)]


class _ArrayRow(msgspec.Struct, array_like=True, forbid_unknown_fields=True, gc=False):
    """The contents of the extension type of numpy arrays."""

    dtype: str
    shape: Annotated[tuple[_Side, ...], msgspec.Meta(max_length=32)]
    raw: bytes


def _of_numpy(name: str) -> Any:
    """Return a class of numpy; an empty tuple if numpy is not imported yet, so no instance can exist.

    While another thread imports numpy for the first time, the module exists but has no classes.
    """
    return getattr(sys.modules.get("numpy"), name, ())


def is_array(value: Any) -> bool:
    """Return whether a value is a numpy array."""
    return isinstance(value, _of_numpy("ndarray"))


def is_number(value: Any) -> bool:
    """Return whether a value is a numpy number or boolean, such as what `array.sum()` returns."""
    return isinstance(value, _of_numpy("generic")) and value.dtype.kind in "biuf"


def is_number_type(kind: type) -> bool:
    """Return whether a type is one of numpy's numbers, such as `numpy.float64`."""
    return issubclass(kind, _of_numpy("generic"))


# As bytes ------------------------------------------------------------------------------------------------------


def extension_from_array(array: Any, where: str) -> msgspec.msgpack.Ext:
    """Return an array as a msgpack extension.

    Args:
        array: the array.
        where: the path to it, for error messages.

    Raises:
        LocalProtocolError: it contains anything but numbers and booleans.
    """
    dtype = array.dtype.str
    if not _DTYPE.match(dtype):
        raise LocalProtocolError(f"{where} is an array of {array.dtype}, and only numbers and booleans can be sent")
    return msgspec.msgpack.Ext(ARRAY_EXTENSION, codecs.encode((dtype, array.shape, array.tobytes())))


def array_from_extension(code: int, data: bytes | memoryview) -> Any:
    """Make a read-only numpy array that shares the memory of the received bytes.

    Raises:
        RemoteProtocolError: the bytes are not an array of numbers or booleans.
    """
    if code != ARRAY_EXTENSION:
        raise RemoteProtocolError(f"a frame contains an extension type that is not ours: {code}")
    limit = len(data)
    try:
        array = codecs.convert(
            msgpack.unpackb(data, max_array_len=64, max_map_len=0, max_str_len=8, max_bin_len=limit, max_ext_len=0),
            _ArrayRow,
        )
    except (ValueError, TypeError) as error:  # msgspec's ValidationError is a ValueError
        raise RemoteProtocolError(f"a frame contains a malformed array: {error}") from None
    if not _DTYPE.match(array.dtype):
        raise RemoteProtocolError(f"a frame contains an array of {array.dtype!r}, not of numbers or booleans")
    if math.prod(array.shape) * int(array.dtype[2:]) != len(array.raw):
        raise RemoteProtocolError(f"a frame contains an array of the shape {array.shape} in {len(array.raw)} bytes")
    import numpy

    return numpy.frombuffer(array.raw, dtype=array.dtype).reshape(array.shape)


def saved_array(value: Any) -> msgspec.msgpack.Ext:
    """Return an array of a task's settings or state as a msgpack extension: msgspec's `enc_hook`.

    Raises:
        TypeError: it is not an array of numbers or booleans.
    """
    if not is_array(value):
        raise TypeError(f"it contains a value of the class {type(value).__name__}, which cannot be saved")
    check_items(value)
    return extension_from_array(value, "an array")


def check_items(array: Any) -> None:
    """Refuse an array that cannot be saved.

    Raises:
        TypeError: it contains anything but numbers and booleans.
    """
    if not _DTYPE.match(array.dtype.str):
        raise TypeError(f"it contains an array of {array.dtype}, and only arrays of numbers and booleans can be saved")


# As values of settings and state -------------------------------------------------------------------------------


def unaliased(kind: Any) -> Any:
    """Return a type with type aliases replaced: from numpy 2.5 on, `NDArray` is one."""
    while True:
        alias = kind if isinstance(kind, _ALIAS) else get_origin(kind)
        if not isinstance(alias, _ALIAS):
            return kind
        kind = alias.__value__ if alias is kind else alias.__value__[get_args(kind)]


def is_array_type(kind: Any) -> bool:
    """Return whether a field's type is `numpy.ndarray`, with or without the type of its items."""
    kind = unaliased(kind)
    array = _of_numpy("ndarray")
    return array != () and (kind is array or get_origin(kind) is array)


def fault_of_array_type(kind: Any) -> str:
    """Return why arrays of a type cannot be saved; empty: they can."""
    wanted = _dtype_of(kind)
    if wanted is None or isinstance(wanted, type) or _DTYPE.match(wanted.str):
        return ""
    return f"is an array of {wanted}, and only arrays of numbers and booleans can be saved: write NDArray[np.float64]"


def array_of(kind: Any, value: Any) -> Any:
    """Make a new array for a field of settings or state: msgspec's `dec_hook`.

    An array keeps its dtype and shape. A list becomes an array of the field's item type. If the field has none, it
    becomes float64, or boolean if all items are booleans.

    Args:
        kind: the field's type, such as `numpy.ndarray` or `NDArray[numpy.float32]`.
        value: an array, or (nested) lists of numbers or booleans.

    Raises:
        ValueError: it is neither, or does not fit the type.
        NotImplementedError: the field is of another type.
    """
    if not is_array_type(kind):
        raise NotImplementedError
    import numpy

    wanted = _dtype_of(kind)
    if is_array(value):
        if not _DTYPE.match(value.dtype.str):
            raise ValueError(f"expected an array of numbers or booleans, not of {value.dtype}")
        given = numpy.array(value)
        if wanted is None or (isinstance(wanted, type) and issubclass(given.dtype.type, wanted)):
            return given
        if isinstance(wanted, type) or not numpy.can_cast(given.dtype, wanted, "same_kind"):
            raise ValueError(f"expected an array of {getattr(wanted, '__name__', wanted)}, not of {given.dtype}")
        with numpy.errstate(all="ignore"):
            return given.astype(wanted)
    if not isinstance(value, (list, tuple)):
        raise ValueError("expected a list of numbers, or lists of them")
    kinds = set(_kinds_in(value))
    if not kinds <= {int, float} and kinds != {bool}:
        raise ValueError("expected a list of numbers, or lists of them, or the same of only true and false")
    if wanted is None or isinstance(wanted, type):
        wanted = _usual(wanted, kinds)
    if (wanted.kind == "b") != (kinds == {bool}) and kinds:
        raise ValueError(f"expected a list of {'true and false' if wanted.kind == 'b' else 'numbers'}")
    if wanted.kind in "iu" and float in kinds:
        raise ValueError("expected whole numbers")
    try:
        given = numpy.array(value) if kinds else numpy.array(value, wanted)
        with numpy.errstate(all="ignore"):  # values that do not fit are found below
            made = given.astype(wanted)
    except OverflowError:
        raise ValueError(f"has a number that {wanted} cannot represent") from None
    except ValueError:
        raise ValueError("expected lists of the same length") from None
    fits = (made == given).all() if wanted.kind in "iu" else (numpy.isfinite(made) == numpy.isfinite(given)).all()
    if not fits:
        raise ValueError(f"has a number that {wanted} cannot represent")
    return made


def _dtype_of(kind: Any) -> Any:
    """Return the type of an array's items: a dtype, an abstract class such as `numpy.floating`, or None for any."""
    import numpy

    arguments = get_args(unaliased(kind))
    items = get_args(arguments[1]) if len(arguments) == 2 else ()
    item = items[0] if items else None
    if not isinstance(item, type) or item is numpy.generic:
        return None
    abstract = item in (numpy.number, numpy.inexact, numpy.floating, numpy.complexfloating) or item in (
        numpy.integer,
        numpy.signedinteger,
        numpy.unsignedinteger,
    )
    return item if abstract else numpy.dtype(item)


def _usual(abstract: type | None, kinds: set[type]) -> Any:
    import numpy

    if abstract is None:
        return numpy.dtype(bool if kinds == {bool} else float)
    usual = (numpy.float64, numpy.int64, numpy.uint64, numpy.complex128)
    return numpy.dtype(next(one for one in usual if issubclass(one, abstract)))


def _kinds_in(value: Any) -> Iterator[type]:
    """Yield the types of the values in nested lists."""
    ahead = [value]
    while ahead:
        for item in ahead.pop():
            if isinstance(item, (list, tuple)):
                ahead.append(item)
            else:
                yield type(item)


def as_list(array: Any) -> Any:
    """Return an array or numpy number as lists of numbers; a complex number is a list of its two parts.

    Raises:
        TypeError: it is not an array.
    """
    if not hasattr(array, "tolist"):
        raise TypeError(f"a {type(array).__name__} is not a plain value")
    if getattr(getattr(array, "dtype", None), "kind", "") == "c":
        import numpy

        return numpy.stack((array.real, array.imag), axis=-1).tolist()
    return array.tolist()


def without_arrays(value: Any) -> Any:
    """Return a plain value with all arrays in it, at any depth, replaced by lists."""
    if is_array(value) or is_number(value):
        return as_list(value)
    if isinstance(value, Mapping):
        return {key: without_arrays(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return [without_arrays(item) for item in value]
    return value


def alike(one: Any, other: Any) -> bool:
    """Return whether two plain values are equal; arrays are equal if their dtype, shape and bytes are."""
    if is_array(one) or is_array(other):
        if not (is_array(one) and is_array(other)):
            return False
        return bool(one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes())
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(alike, one, other))
    return bool(one == other)
