"""Check the numbers that devices say and are told: readings, commands and battery levels. One place for all drivers.

A number of a reading or a command must be finite, and within the bounds of its field: `Annotated[float, Meta(ge=0,
le=1)]`. A field whose number may be missing is a `MaybeNan`. Numbers in arrays are checked only in commands: in a depth
image, NaN is what was not measured. A battery level beyond its range is rejected, not clamped: a device that reports
percent where fractions are expected would always seem full.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Annotated, Any, Final, TypeAlias

import msgspec
from msgspec import inspect

from pancakes.errors import PancakesError
from pancakes.packet import body_to_plain, has_fields
from pancakes.util import codecs
from pancakes.util.arrays import is_array

MaybeNan: TypeAlias = Annotated[float, msgspec.Meta(extra={"nan": True})]
"""A number that is NaN if it is not known."""

_Check = Callable[[Any], str]
"""Says what is wrong with a value, as what follows its name: ` is nan`; empty: nothing."""
_BOUNDS: Final = (
    ("ge", operator.ge, "below"),
    ("gt", operator.gt, "not above"),
    ("le", operator.le, "above"),
    ("lt", operator.lt, "not below"),
)


def reading_check(cls: Any) -> Callable[[Any], str] | None:
    """Return what checks the bodies of a class as readings; None: there is no number in them.

    It returns which number is no reading, as ` is 1.2, above 1` behind the name of its field; empty: all are sound.
    """
    return _check_of_class(cls, arrays=False)


def fault_of_command(body: Any) -> str:
    """Say why the body of a packet is no command that an actuator can carry out; empty: it is one.

    A body that a task of this agent has made was never decoded, so what its fields are is looked at as well.
    """
    cls: Any = type(body)
    check = _check_of_class(cls, arrays=True)
    if check is not None and (fault := check(body)):
        return fault.lstrip(".")
    try:
        if not _has_arrays(cls):
            codecs.convert(body_to_plain(body), cls)
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        return str(error)
    return ""


@cache
def _has_arrays(cls: Any) -> bool:
    return "CustomType" in repr(codecs.type_info(cls))


@cache
def _check_of_class(cls: Any, arrays: bool) -> _Check | None:
    if not has_fields(cls):
        return _checks_any(arrays)
    try:
        info = codecs.type_info(cls)
    except (TypeError, NameError):  # a class that msgspec cannot decode is not for other agents
        return _checks_any(arrays)
    return _check_of(info, arrays, ())


def _check_of(info: inspect.Type, arrays: bool, within: tuple[type, ...]) -> _Check | None:
    """Return what checks values of a type; None: there is no number in them.

    Args:
        info: the type.
        arrays: whether the numbers in arrays are looked at.
        within: the classes of which it is a part.
    """
    match info:
        case inspect.Metadata():
            if (info.extra or {}).get("nan"):
                return _check_maybe_nan
            return _check_of(info.type, arrays, within)
        case inspect.FloatType() | inspect.IntType():
            return _checks_number(info)
        case inspect.UnionType():
            return _checks_union(info, arrays, within)
        case inspect.StructType() | inspect.DataclassType():
            return _checks_fields(info, arrays, within)
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() | inspect.FrozenSetType():
            check = _check_of(info.item_type, arrays, within)
            return _checks_numbers(check) if _is_unbound(info.item_type) else _checks_items(check)
        case inspect.TupleType() | inspect.DictType() | inspect.AnyType() | inspect.CustomType():
            return _checks_any(arrays)
    return None


def _checks_union(info: inspect.UnionType, arrays: bool, within: tuple[type, ...]) -> _Check | None:
    checks = [check for it in info.types if (check := _check_of(it, arrays, within)) is not None]
    if not checks:
        return None
    others = [it for it in info.types if not isinstance(it, inspect.NoneType)]
    if len(others) > 1:
        return _checks_any(arrays)
    return lambda value: "" if value is None else checks[0](value)


def _checks_fields(
    info: inspect.StructType | inspect.DataclassType, arrays: bool, within: tuple[type, ...]
) -> _Check | None:
    if info.cls in within:  # a class that has itself as a part
        return _checks_any(arrays)
    made = [(field.name, _check_of(field.type, arrays, (*within, info.cls))) for field in info.fields]
    checks = [(name, operator.attrgetter(name), check) for name, check in made if check is not None]
    if not checks:
        return None

    def check_fields(value: Any) -> str:
        if not isinstance(value, info.cls):  # a body that was made here was never decoded
            return f" is {value!r}, which is no {info.cls.__name__}"
        for name, get, check in checks:
            if fault := check(get(value)):
                return f".{name}{fault}"
        return ""

    if len(checks) < 2 or not all(_is_unbound(field.type) for field in info.fields):
        return check_fields
    cls, get_all = info.cls, operator.attrgetter(*(name for name, _, _ in checks))

    def check_numbers(value: Any) -> str:
        # A sum is finite only if all of its numbers are: most readings need no look at each.
        try:
            if isinstance(value, cls) and math.isfinite(sum(get_all(value))):
                return ""
        except (TypeError, OverflowError):
            pass
        return check_fields(value)

    return check_numbers


def _checks_items(check: _Check | None) -> _Check | None:
    if check is None:
        return None

    def check_items(value: Any) -> str:
        if not isinstance(value, Iterable):
            return f" is {value!r}, which is no list"
        for number, item in enumerate(value):
            if fault := check(item):
                return f"[{number}]{fault}"
        return ""

    return check_items


def _is_unbound(info: inspect.Type) -> bool:
    number = isinstance(info, (inspect.FloatType, inspect.IntType))
    return number and all(getattr(info, key) is None for key, _, _ in _BOUNDS)


def _checks_numbers(check: _Check | None) -> _Check | None:
    """Return what checks many numbers: a scan has hundreds, so they are looked at one by one only if one is none."""
    check_items = _checks_items(check)
    assert check_items is not None

    def check_numbers(value: Any) -> str:
        try:
            if all(map(math.isfinite, value)):
                return ""
        except (TypeError, OverflowError):
            pass
        return check_items(value)

    return check_numbers


def _checks_number(info: inspect.FloatType | inspect.IntType) -> _Check:
    bounds = [(holds, getattr(info, key), word) for key, holds, word in _BOUNDS if getattr(info, key) is not None]

    def check_number(value: Any) -> str:
        try:
            if not math.isfinite(value):
                return f" is {value}"
        except (TypeError, OverflowError):
            return f" is {value!r}, which is no number"
        for holds, bound, word in bounds:
            if not holds(value, bound):
                return f" is {value:g}, {word} {bound:g}"
        return ""

    return check_number


def _check_maybe_nan(value: Any) -> str:
    return f" is {value}" if value in (math.inf, -math.inf) else ""


def _checks_any(arrays: bool) -> _Check:
    def check_any(value: Any) -> str:
        if isinstance(value, float):
            return "" if math.isfinite(value) else f" is {value}"
        if isinstance(value, Mapping):
            parts: Any = ((f"[{key!r}]", item) for key, item in value.items())
        elif isinstance(value, (list, tuple)):
            parts = ((f"[{number}]", item) for number, item in enumerate(value))
        elif is_array(value):
            return _fault_of_array(value) if arrays else ""
        elif has_fields(type(value)):
            cls: Any = type(value)
            check = _check_of_class(cls, arrays)
            return check(value) if check is not None else ""
        else:
            return ""
        for where, item in parts:
            if fault := check_any(item):
                return f"{where}{fault}"
        return ""

    return check_any


def _fault_of_array(array: Any) -> str:
    import numpy

    if array.dtype.kind in "fc" and not numpy.isfinite(array).all():
        return " has a number in it that is not finite"
    return ""


ROUNDING: Final = 1e-5
"""So much a level may be beyond its range: devices reckon in numbers of 32 bits."""
ABOVE: Final = 0.1
"""While it is charged, a battery's voltage may be above that of a full one by this share of its range."""


def level_of(told: float, full: float) -> float:
    """Return a level, from 0 to 1.

    Args:
        told: what the device tells.
        full: what it tells when the battery is full: 100 for percent, 1 for fractions.

    Raises:
        PancakesError: that is no level.
    """
    level = told / full
    if not -ROUNDING <= level <= 1.0 + ROUNDING:
        hint = ": set full = 100 if it speaks in percent" if full == 1.0 and 1.0 < told <= 100.0 else ""
        raise PancakesError(f"a level of {told:g} is not between 0 and full = {full:g}{hint}")
    return min(1.0, max(0.0, level))


def level_at(voltage_v: float, empty_v: float, full_v: float) -> float:
    """Return the level that a voltage means, from 0 to 1; it is taken to be proportional between the two bounds.

    A battery that is more than empty is empty, down to half of that voltage; below, none is connected.

    Raises:
        PancakesError: the voltage is none that this battery can have.
    """
    level = (voltage_v - empty_v) / (full_v - empty_v)
    if level > 1.0 + ABOVE:
        raise PancakesError(f"{voltage_v:g} V is more than a battery has whose full_v is {full_v:g} V: correct full_v")
    if not voltage_v >= 0.5 * empty_v:
        raise PancakesError(
            f"{voltage_v:g} V is less than half of empty_v, which is {empty_v:g} V: is the battery connected?"
        )
    return min(1.0, max(0.0, level))
