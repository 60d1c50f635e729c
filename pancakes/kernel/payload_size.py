"""Estimate how many bytes a packet's body takes, to bound queues whose packets can be large.

Text, bytes, arrays and rows of numbers make a body large. So a body is searched for these, breadth first, and
everything else counts as a number. If the types of all fields are small, nothing is searched. Pure.
"""

from __future__ import annotations

import enum
import types
from array import array
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from msgspec import Meta

from pancakes.packet import field_names

LIGHT_BYTES: Final = 2048
"""A lighter body is not counted: the number of packets that may wait bounds them well enough."""
BRIEF_BYTES: Final = 16 * 1024
"""Of a value larger than this only the size is shown."""
SAMPLE: Final = 256
"""Of more things in a list or map this many are looked at, spread over it, and stand for the rest."""
MOST_VALUES: Final = 1000
"""The most values of one body that are looked at; each that is left counts as a number."""
NUMBER_BYTES: Final = 32
"""A number, and the pointer to it."""

SHORT: Final = 256
"""A text that may not be longer, as its type says, counts as a number: so do names."""
FEW: Final = 8
"""And a row that may not have more things of one size."""

_NUMBERS: Final = (int, float, complex, type(None))


def weigh(value: Any) -> int:
    """Return how many bytes a body, or a part of one, takes, roughly. It never raises."""
    size: float = 0.0
    seen = 0
    # Each with the number of values that it stands for.
    waiting: deque[tuple[Any, float]] = deque([(value, 1.0)])
    while waiting and seen < MOST_VALUES:
        item, times = waiting.popleft()
        seen += 1
        kind = item.__class__
        if kind is str or kind is bytes:
            size += times * len(item)
            continue
        fields = _large_fields(kind)
        if fields is not None:
            size += 0 if fields else times * NUMBER_BYTES
            for name, item_bytes in fields:
                part = getattr(item, name, None)
                if item_bytes and isinstance(part, (str, bytes, list, tuple)):
                    size += times * item_bytes * len(part)
                else:
                    waiting.append((part, times))
            continue
        parts = _parts_of(item)
        if isinstance(parts, int):
            size += times * parts
            continue
        sample = parts[:: len(parts) // SAMPLE | 1]  # an odd step: of two kinds in turns it finds both
        each = times * len(parts) / max(1, len(sample))
        large = (
            [] if all(map(is_small, set(map(type, sample)))) else [it for it in sample if not is_small(it.__class__)]
        )
        size += each * NUMBER_BYTES * (len(sample) - len(large))
        waiting.extend([(part, each) for part in large])
    return int(size + NUMBER_BYTES * sum(times for _, times in waiting))


def weight_of(body: Any) -> int:
    """Return the bytes of a packet's body if they count; 0 for a light one."""
    fields = _large_fields(body.__class__)
    if fields is None:
        weight = weigh(body)
    else:
        weight = 0
        for name, item_bytes in fields:  # of most bodies these are texts and rows of numbers, whose lengths say it all
            part = getattr(body, name, None)
            if item_bytes and isinstance(part, (str, bytes, list, tuple)):
                weight += item_bytes * len(part)
            else:
                weight += weigh(part)
    return weight if weight > LIGHT_BYTES else 0


@lru_cache(maxsize=1024)
def is_small(cls: type) -> bool:
    """Return whether all bodies of a class are of one small size, as the types of its fields say."""
    return _large_fields(cls) == ()


def in_brief(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for people to read: of each that is larger than `BRIEF_BYTES`, only how many bytes it takes."""
    weights = {name: weigh(value) for name, value in values.items()}
    return {
        name: value if weights[name] <= BRIEF_BYTES else f"about {weights[name]} bytes"
        for name, value in values.items()
    }


def _parts_of(value: Any) -> Sequence[Any] | int:
    """Return what a value contains; its bytes if that is known, or if it contains nothing."""
    if isinstance(value, (list, tuple)):
        return value
    if isinstance(value, dict):
        return [*value, *value.values()]
    size = getattr(value, "nbytes", None)  # an array of numpy's, or a memoryview
    if isinstance(size, int):
        return size
    try:
        if isinstance(value, (bytearray, array)):
            return memoryview(value).nbytes
        if isinstance(value, Mapping):
            return [*value, *value.values()]
        return list(value) if isinstance(value, Collection) else NUMBER_BYTES
    except RuntimeError:  # another thread changes it, which no publisher should do
        return NUMBER_BYTES


@lru_cache(maxsize=1024)
def _large_fields(cls: type) -> tuple[tuple[str, int], ...] | None:
    """Return the fields of a class that may be large, as their types say; None if nothing is known of it.

    Beside each is how many bytes each item of it takes, if that is known; else 0.
    """
    if issubclass(cls, (*_NUMBERS, enum.Enum)):
        return ()
    names = field_names(cls) or getattr(cls, "_fields", ())
    if not names:
        return None
    try:
        hints = get_type_hints(cls, include_extras=True)
        large = [(name, hints.get(name, Any)) for name in names]
        return tuple((name, _bytes_of_items(hint)) for name, hint in large if not _is_small(hint))
    except Exception:  # a type that is imported for checks only, or one that contains itself
        return tuple((name, 0) for name in names)


def _bytes_of_items(hint: Any) -> int:
    """Return the bytes of each character of a text, or of each number of a row of numbers; 0: that is not known."""
    if get_origin(hint) is Annotated:
        return _bytes_of_items(get_args(hint)[0])
    if hint in (str, bytes):
        return 1
    items = [part for part in get_args(hint) if part is not Ellipsis]
    rows = get_origin(hint) in (list, tuple) and all(_is_small(item) for item in items)
    return NUMBER_BYTES if rows else 0


def _is_small(hint: Any) -> bool:
    parts = get_args(hint)
    if get_origin(hint) is Annotated:
        return _is_short(parts[0], parts[1:]) or _is_small(parts[0])
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return Ellipsis not in parts and all(_is_small(part) for part in parts)
    return get_origin(hint) is Literal or (isinstance(hint, type) and is_small(hint))


def _is_short(hint: Any, limits: Sequence[Any]) -> bool:
    """Return whether a text, or a row of things of one size, may not be long, as its type says."""
    longest = min((it.max_length for it in limits if isinstance(it, Meta) and it.max_length is not None), default=None)
    if longest is None:
        return False
    if hint in (str, bytes):
        return bool(longest <= SHORT)
    items = [part for part in get_args(hint) if part is not Ellipsis]
    return longest <= FEW and get_origin(hint) in (list, tuple) and all(map(_is_small, items))
