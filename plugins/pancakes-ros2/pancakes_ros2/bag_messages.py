"""Messages for bags: made empty, and as bytes, by `rosbags` and without a ROS 2."""

from __future__ import annotations

from typing import Any, Final

import numpy
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from pancakes_ros2.message_fields import Unusable

RELEASE: Final = Stores.ROS2_JAZZY
"""The release whose message types a bag gets; those used here are the same in the releases before and after it."""
_TEXTS: Final = ("string", "wstring")


def typestore() -> Typestore:
    """Return the message types of a release."""
    return get_typestore(RELEASE)


def empty(store: Typestore, kind: str) -> Any:
    """Return an empty message, as ROS 2 makes it: numbers are 0, texts and lists are empty."""
    _, fields = store.fielddefs[kind]
    return store.types[kind](**{name: _empty(store, node) for name, node in fields})


def _empty(store: Typestore, node: Any) -> Any:
    shape, of = node
    if shape == Nodetype.NAME:
        return empty(store, of)
    if shape == Nodetype.BASE:
        return _zero(of[0])
    if shape == Nodetype.SEQUENCE:
        return []
    item, count = of
    if item[0] == Nodetype.BASE and item[1][0] not in _TEXTS:
        return numpy.zeros(count, dtype=item[1][0])
    return [_empty(store, item) for _ in range(count)]


def _zero(base: str) -> Any:
    if base in _TEXTS:
        return ""
    return False if base == "bool" else 0.0 if base.startswith("float") else 0


def to_bytes(store: Typestore, kind: str, message: Any) -> bytes:
    """Return a message as CDR.

    Raises:
        Unusable: a value does not fit its field.
    """
    try:
        _finish(store, kind, message)
        return bytes(store.serialize_cdr(message, kind))
    except Exception as error:  # rosbags checks little, and struct and numpy say what they like
        raise Unusable(f"a value does not fit {kind}: {error or type(error).__name__}") from None


def _finish(store: Typestore, kind: str, message: Any) -> None:
    """Make arrays of the lists of numbers in a message: `rosbags` serialises no others."""
    for name, (shape, of) in store.fielddefs[kind][1]:
        value = getattr(message, name)
        if shape == Nodetype.NAME:
            _finish(store, of, value)
        elif shape in (Nodetype.SEQUENCE, Nodetype.ARRAY):
            (inner, inner_of), _ = of
            if inner == Nodetype.NAME:
                for item in value:
                    _finish(store, inner_of, item)
            elif inner_of[0] not in _TEXTS:
                setattr(message, name, numpy.asarray(value, dtype=inner_of[0]))
