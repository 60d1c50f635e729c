"""How many bytes a packet's body takes, about: what bounds a queue where bodies can be large.

Bodies of most classes are of a fixed, small size, because all of their fields are: a queue of them is bounded by its
number of packets, and nothing is weighed. Only a class that has text, bytes, lists, maps, arrays or fields of unknown
type is weighed, packet by packet; of a long list a sample.
"""

from __future__ import annotations

import enum
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from itertools import islice
from operator import attrgetter
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from pancakes.packet import Packet, field_names

LIGHT_BYTES: Final = 2048
"""A lighter body is not counted: the number of packets that may wait bounds them well enough."""
BRIEF_BYTES: Final = 16 * 1024
"""What is told of a value larger than this is how large it is."""
SAMPLE: Final = 32
"""So many items of a longer list or map are weighed, spread over it, and stand for the rest; a quarter in each list
within that, and so on.
"""
MOST_VALUES: Final = 1000
"""So many values of one body are looked at; what is left counts as a number each."""
MOST_DEPTH: Final = 32
"""What is nested deeper cannot travel, and is not looked at."""

Weigher = Callable[[Any], int]

_FIXED: Final = (int, float, bool, complex, type(None))
_NUMBERS: Final = (int, float, bool)
_PLAIN: Final = (str, bytes, bytearray)
_POINTER: Final = 8
_NUMBER: Final = 32  # a float or an int, and the pointer to it


def weigher(cls: type) -> Weigher | None:
    """Returns what weighs bodies of a class.

    Returns:
        None where all bodies of the class are of one small size; else a function of a body (it takes one of another
        class, too) that returns its bytes, roughly, and never raises.
    """
    return _weigher(cls)


@cache
def _weigher(cls: type) -> Weigher | None:
    names = field_names(cls)
    if not names:
        return None if issubclass(cls, (*_FIXED, enum.Enum)) else weigh
    try:
        hints = get_type_hints(cls)
    except Exception:  # a class may name a type that is imported for checks only: nothing is known of its fields
        return weigh
    varying = {name: hints.get(name, Any) for name in names if not _is_fixed(hints.get(name, Any), MOST_DEPTH)}
    if not varying:
        return None
    units = {name: _unit(hint) for name, hint in varying.items()}
    rows = {name: _rows(varying[name]) for name, unit in units.items() if not unit}
    if not all(rows.values()):
        return weigh
    lengths = tuple((name, unit) for name, unit in units.items() if unit)
    return _sum_of_lengths(lengths, tuple((name, weigh_row) for name, weigh_row in rows.items() if weigh_row))


def light_on_the_wire(cls: type) -> int:
    """Returns how many bytes a packed body of a class may take and be sure to be light; 0 where it must be weighed.

    That can be said where nothing but text and bytes makes it heavy: those weigh what they take on the wire, or less.
    Numbers do not, since small ones are packed into a byte each.
    """
    return _light_on_the_wire(cls)


@cache
def _light_on_the_wire(cls: type) -> int:
    try:
        hints = get_type_hints(cls)
    except Exception:  # as in `weigher`
        return 0
    names = field_names(cls)
    text_only = all(_is_fixed(hints.get(name, Any), MOST_DEPTH) or hints.get(name) in _PLAIN for name in names)
    return LIGHT_BYTES if names and text_only else 0


def weigh(value: Any) -> int:
    """Returns how many bytes a body, or a part of one, takes, roughly. It never raises."""
    return _Scales().weigh(value, 0)


def heavy_weight(packet: Packet) -> int:
    """Returns the bytes of a packet's body where it is a heavy one; of a light one 0."""
    weigh = weigher(type(packet.body))
    weight = weigh(packet.body) if weigh is not None else 0
    return weight if weight > LIGHT_BYTES else 0


def in_brief(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values for people to read: of each that is larger than `BRIEF_BYTES`, only how many bytes it takes."""
    weights = {name: weigh(value) for name, value in values.items()}
    return {
        name: value if weights[name] <= BRIEF_BYTES else f"about {weights[name]} bytes"
        for name, value in values.items()
    }


def _sum_of_lengths(units: tuple[tuple[str, int], ...], rows: tuple[tuple[str, Weigher], ...] = ()) -> Weigher:
    """The usual case, and the cheapest: fields of text, bytes, or numbers or simple things in a row."""
    of_each_unit = _values_by_unit(units)

    def weigh_lengths(body: Any) -> int:
        size = 0
        try:
            for unit, values in of_each_unit:
                for value in values(body):
                    size += unit * len(value)
            for name, weigh_row in rows:
                size += weigh_row(getattr(body, name))
        except (AttributeError, TypeError):  # not of this class, or not what the class says
            return weigh(body)
        return size

    return weigh_lengths


def _values_by_unit(units: Sequence[tuple[str, int]]) -> tuple[tuple[int, Callable[[Any], tuple[Any, ...]]], ...]:
    """Returns for each unit what gets the fields that are weighed with it, all at once."""
    names: dict[int, list[str]] = {}
    for name, unit in units:
        names.setdefault(unit, []).append(name)
    return tuple((unit, _getter(its)) for unit, its in names.items())


def _getter(names: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    (name,) = names
    return lambda body: (getattr(body, name),)


def _unit(hint: Any) -> int:
    """Returns how many bytes each item of a field takes; 0 where that cannot be said."""
    if hint in _PLAIN:
        return 1
    parts = [part for part in get_args(hint) if part is not Ellipsis]
    if get_origin(hint) in (list, tuple) and parts and all(part in _NUMBERS for part in parts):
        return _NUMBER
    return 0


def _rows(hint: Any) -> Weigher | None:
    """Returns what weighs a list or tuple of things of one class, where that has only the simplest of fields."""
    parts = [part for part in get_args(hint) if part is not Ellipsis]
    if get_origin(hint) not in (list, tuple) or len(parts) != 1 or not isinstance(parts[0], type):
        return None
    names = field_names(parts[0])
    try:
        hints = get_type_hints(parts[0])
    except Exception:  # as in `weigher`
        return None
    units = {name: _unit(hints.get(name, Any)) for name in names if not _is_fixed(hints.get(name, Any), MOST_DEPTH)}
    if not names or not all(units.values()):
        return None
    weigh_item = _sum_of_lengths(tuple(units.items()))
    least = _POINTER + _NUMBER * len(names)

    def weigh_row(items: Any) -> int:
        count = len(items)
        some = items if count <= SAMPLE else items[:: -(-count // SAMPLE)]
        size = 0
        for item in some:
            size += least + weigh_item(item)
        return size * count // len(some) if some else 0

    return weigh_row


def _is_fixed(hint: Any, depth: int) -> bool:
    """Returns whether all values of a type are of one small size."""
    if hint in _FIXED:
        return True
    origin = get_origin(hint)
    if origin is Annotated:
        return _is_fixed(get_args(hint)[0], depth)
    if origin is Literal:
        return True
    if origin in (Union, types.UnionType):
        return all(_is_fixed(part, depth) for part in get_args(hint))
    if origin is tuple:
        parts = get_args(hint)
        return Ellipsis not in parts and all(_is_fixed(part, depth) for part in parts)
    if not isinstance(hint, type) or depth == 0:
        return False
    if issubclass(hint, enum.Enum):
        return True
    if not (is_dataclass(hint) or issubclass(hint, msgspec.Struct)):
        return False
    try:
        hints = get_type_hints(hint)
    except Exception:  # as in `weigher`
        return False
    return all(_is_fixed(hints.get(name, Any), depth - 1) for name in field_names(hint))


class _Scales:
    """Weighs one body."""

    def __init__(self) -> None:
        self._left = MOST_VALUES

    def weigh(self, value: Any, depth: int) -> int:
        """Returns the bytes of a value that is nested so deep."""
        self._left -= 1
        if isinstance(value, _PLAIN):
            return len(value)
        if value is None or isinstance(value, (int, float, complex, enum.Enum)):
            return _NUMBER
        size = getattr(value, "nbytes", None)  # an array of numpy's, or a memoryview
        if isinstance(size, int):
            return size
        if self._left <= 0 or depth >= MOST_DEPTH:
            return _NUMBER
        if isinstance(value, dict):
            return self._all(value, depth) + self._all(value.values(), depth)
        if isinstance(value, (list, tuple, set, frozenset)):
            return self._all(value, depth)
        return sum(self.weigh(getattr(value, name, None), depth + 1) for name in field_names(type(value)))

    def _all(self, items: Collection[Any], depth: int) -> int:
        """Weighs a sample, evenly spread, and returns what all are thought to weigh."""
        count = len(items)
        try:
            some = list(islice(items, 0, None, -(-count // max(1, SAMPLE >> 2 * depth)) or 1))
        except RuntimeError:  # its owner changes it meanwhile, which no publisher should
            return _NUMBER * count
        if some and type(some[0]) in _NUMBERS and type(some[-1]) in _NUMBERS:
            return _NUMBER * count
        weighed = sum(_POINTER + self.weigh(item, depth + 1) for item in some)
        return weighed * count // len(some) if some else 0
