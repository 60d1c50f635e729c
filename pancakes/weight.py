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
"""Of more things in a list or map so many are weighed, spread over it, and stand for the rest."""
LOOKED_THROUGH: Final = 256
"""Texts and bytes are sought out of so many items of a list or map; a look costs 0.02 µs an item. In a longer one the
sample stands for these as well.
"""
MOST_VALUES: Final = 1000
"""Into so many values of one body one looks, evenly spread; an item of what is left counts as a number."""
MOST_DEPTH: Final = 32
"""What is nested deeper cannot travel, and is not looked at."""

Weigher = Callable[[Any], int]

_FIXED: Final = (int, float, bool, complex, type(None))
_NUMBERS: Final = (int, float, bool)
_PLAIN: Final = (str, bytes, bytearray)
_ROWS: Final = (list, tuple, set, frozenset)
_OF_NUMBERS: Final = frozenset(_FIXED)
_OF_PLAIN: Final = frozenset(_PLAIN)
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
    return _weigh(value, MOST_VALUES, 0)


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
        some = items if count <= SAMPLE else items[:: _step(count, SAMPLE)]
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


def _weigh(value: Any, share: int, depth: int) -> int:
    """Returns the bytes of a value that is nested so deep; `share`: into so many values within it one may look."""
    if isinstance(value, _PLAIN):
        return len(value)
    if value is None or isinstance(value, (int, float, complex, enum.Enum)):
        return _NUMBER
    size = getattr(value, "nbytes", None)  # an array of numpy's, or a memoryview
    if isinstance(size, int):
        return size
    if share < 1 or depth >= MOST_DEPTH:
        return _NUMBER * (1 + len(value)) if isinstance(value, (dict, *_ROWS)) else _NUMBER
    if isinstance(value, dict):
        return _weigh_all(value, 0, depth) + _weigh_all(value.values(), share, depth)
    if isinstance(value, _ROWS):
        return _weigh_all(value, share, depth)
    names = field_names(type(value))
    if names:
        return _weigh_all([getattr(value, name, None) for name in names], share, depth)
    return _weigh_strange(value, share, depth)


def _weigh_strange(value: Any, share: int, depth: int) -> int:
    """Weighs what cannot travel, but may be published for this agent: an `array`, a `deque`, any mapping."""
    try:
        return memoryview(value).nbytes
    except TypeError:
        if isinstance(value, Mapping):
            return _weigh_all(value, 0, depth) + _weigh_all(value.values(), share, depth)
        return _weigh_all(value, share, depth) if isinstance(value, Collection) else _NUMBER


def _weigh_all(items: Collection[Any], share: int, depth: int) -> int:
    """Weighs texts, bytes and numbers all, of other things a sample; of many items only a sample is looked at."""
    count = len(items)
    try:
        is_whole = count <= max(SAMPLE, min(LOOKED_THROUGH, 8 * share))
        some = list(items) if is_whole else list(islice(items, 0, None, _step(count, SAMPLE)))
    except RuntimeError:  # its owner changes it meanwhile, which no publisher should
        return _NUMBER * count
    kinds = set(map(type, some))
    if kinds <= _OF_NUMBERS:
        return _NUMBER * count
    weighed = _POINTER * len(some)
    if kinds <= _OF_PLAIN:
        weighed += sum(map(len, some))
    else:
        others = []
        for item in some:
            kind = type(item)
            if kind in _OF_PLAIN:
                weighed += len(item)
            elif kind in _OF_NUMBERS:
                weighed += _NUMBER
            else:
                others.append(item)
        if others:
            weighed += _weigh_others(others, share, depth)
    return weighed * count // len(some)


def _weigh_others(items: Sequence[Any], share: int, depth: int) -> int:
    """Weighs things that have others in them: each gets as much of the share as its siblings."""
    some = items[:: _step(len(items), max(1, min(SAMPLE, share // 2)))]
    each = (share - len(some)) // len(some)
    return sum([_weigh(item, each, depth + 1) for item in some]) * len(items) // len(some)


def _step(count: int, most: int) -> int:
    """Returns how far apart a sample of so many at the most is taken.

    Never a multiple of 2 or 3: of a list in which small and large things take turns, it would see one kind only.
    """
    step = -(-count // most) or 1
    if step > 1:
        step |= 1
        if step % 3 == 0:
            step += 2
    return step
