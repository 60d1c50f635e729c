"""Check that the settings and the state of a task can be saved, and read and checked again.

A task migrates, is written to a journal and is set from a file. A field that cannot is refused when its class is
defined, with its file and line and what to write instead.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Annotated, Any, Final, Union

import msgspec

from pancakes.errors import ClassError
from pancakes.packet import field_names
from pancakes.settings import fault_of_class
from pancakes.util import codecs
from pancakes.util.arrays import array_of, fault_of_array_type, is_array, is_array_type, is_number_type, unaliased
from pancakes.util.class_checks import given_in, place_of_field

_I = msgspec.inspect
_KEYS: Final = (
    _I.StrType,
    _I.IntType,
    _I.FloatType,
    _I.EnumType,
    _I.LiteralType,
    _I.DateTimeType,
    _I.DateType,
    _I.TimeType,
    _I.UUIDType,
    _I.DecimalType,
)
"""What JSON and TOML can write as a key."""
_CONTAINERS: Final = (_I.ListType, _I.SetType, _I.FrozenSetType, _I.VarTupleType, _I.TupleType, _I.DictType)


def check_saved(owner: type, *names: str) -> None:
    """Refuse a class whose settings or state contain what cannot be saved.

    What is named by an annotation that cannot be resolved yet is judged when it is first used.

    Args:
        owner: a class of tasks, services or drivers.
        names: which of its attributes are such classes: `Settings`, `State`. Those that it inherits from such a class
            were judged before; those that are mixed into it are judged here.

    Raises:
        ClassError: says for each fault in which file and line it is, and what to write instead.
    """
    given = [(part, name, value) for part, name, value in given_in(owner) if name in names]
    faults = [fault for part, name, value in given for fault in _faults_of(part, name, value)]
    if faults:
        raise ClassError("\n".join(faults))


def check_words(owner: type, *names: str) -> None:
    """Refuse a class that gives one word for a tuple of words: each of its letters would be taken for one.

    Raises:
        ClassError: names the attribute, and what to write.
    """
    for part, name, value in given_in(owner):
        if name not in names:
            continue
        if isinstance(value, str):
            raise ClassError(f"{place_of_field(part)}: {part.__qualname__}.{name} is {value!r}: write ({value!r},)")
        if not isinstance(value, Sequence) or not all(isinstance(word, str) and word for word in value):
            raise ClassError(f"{place_of_field(part)}: {part.__qualname__}.{name} is {value!r}, and no tuple of names")


def check_offers(owner: str, state: type, offers: tuple[str, ...]) -> None:
    """Refuse a class of tasks that offers bidders what its state has not.

    Raises:
        ClassError: says which field is none.
    """
    unknown = [name for name in offers if name not in field_names(state)]
    if unknown:
        known = ", ".join(field_names(state)) or "none"
        raise ClassError(f"{owner}.offers: {unknown[0]!r} is no field of its State, which has {known}")


def _faults_of(owner: type, name: str, cls: Any) -> Iterator[str]:
    head = f"{owner.__qualname__.rpartition('<locals>.')[2]}.{name}"
    if not isinstance(cls, type):
        yield f"{place_of_field(owner)}: {head} is {cls!r} and no class: write `@dataclass class {name}:` in its place"
        return
    fault = fault_of_class(cls)
    if fault:
        yield f"{place_of_field(cls)}: {fault}"
        return
    for field, kind in _fields_of(cls):
        fault = _fault_of_field(cls, field) or fault_of_type(kind)
        if fault:
            yield f"{place_of_field(cls, field)}: {head}.{field} {fault}"


def _fields_of(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a class with their types; with the error if one cannot be resolved."""
    names = field_names(cls)
    try:
        hints: dict[str, Any] = typing.get_type_hints(cls, include_extras=True)
    except (NameError, TypeError):
        hints = {name: _hint_of(cls, name) for name in names}
    for name in names:
        yield name, hints[name]


def _hint_of(cls: type, name: str) -> Any:
    base = next(base for base in cls.__mro__ if name in inspect.get_annotations(base))
    alone = type(base.__name__, (), {"__annotations__": {name: inspect.get_annotations(base)[name]}})
    alone.__module__ = base.__module__
    try:
        return typing.get_type_hints(alone, include_extras=True)[name]
    except (NameError, TypeError) as error:
        return error


def _fault_of_field(cls: Any, name: str) -> str:
    if dataclasses.is_dataclass(cls):
        if not next(field for field in dataclasses.fields(cls) if field.name == name).init:
            return "has init=False, and what is saved could not be given back: leave that out"
    elif is_array(next(it.default for it in msgspec.structs.fields(cls) if it.name == name)):
        return "has an array as its default, which all tasks would share: write msgspec.field(default_factory=...)"
    return ""


def fault_of_type(kind: Any) -> str:
    """Say why a value of a type cannot be saved, and what to write instead, as the end of a sentence; empty: it can.

    Args:
        kind: a resolved annotation, or the error that came of it.
    """
    try:
        if isinstance(kind, (NameError, TypeError)):
            raise kind
        fault = _fault_in(kind, frozenset())
        if not fault:
            # Unions that it cannot tell apart, and bounds that a type cannot have, msgspec finds only here.
            codecs.convert(_NO_VALUE, kind, array_of)
    except (NameError, msgspec.ValidationError):
        return ""
    except TypeError as error:
        return f"has a type that cannot be checked when it is read again: {error}"
    return fault


_NO_VALUE: Final = type("_NoValue", (), {})()


def _fault_in(kind: Any, inside: frozenset[type]) -> str:
    """Judge a type and what it is made of; `inside` are the classes that it stands in."""
    kind = unaliased(kind)
    while typing.get_origin(kind) is Annotated:
        kind = unaliased(typing.get_args(kind)[0])
    if is_array_type(kind):
        return fault_of_array_type(kind)
    parts = [part for part in typing.get_args(kind) if part is not Ellipsis]
    if typing.get_origin(kind) in (Union, types.UnionType):
        return _fault_in_parts(parts, inside)
    info = _I.type_info(kind)
    if isinstance(info, _I.AnyType) or kind is object:
        return (
            "may be anything, and could not be checked when it is read again: say what it is, such as float,"
            " list[float] or dict[str, float]"
        )
    if isinstance(info, (_I.RawType, _I.ExtType)):
        return "contains what only msgspec can read: write bytes"
    if isinstance(info, _I.CustomType):
        return _fault_of_class(info.cls)
    if isinstance(info, _I.DictType) and not isinstance(_unwrapped(info.key_type), (*_KEYS, _I.AnyType)):
        return "has keys that cannot be written as text: write dict[str, ...]"
    if isinstance(info, (_I.DataclassType, _I.StructType, _I.NamedTupleType, _I.TypedDictType)):
        return _fault_in_fields(info.cls, inside)
    if isinstance(info, (_I.EnumType, _I.LiteralType)):
        return ""
    return _fault_in_parts(parts or ([Any] if isinstance(info, _CONTAINERS) else []), inside)


def _fault_in_parts(parts: list[Any], inside: frozenset[type]) -> str:
    return next((fault for part in parts if (fault := _fault_in(part, inside))), "")


def _fault_in_fields(cls: type, inside: frozenset[type]) -> str:
    if cls in inside or hasattr(cls, "__parameters__"):
        return ""
    for name, kind in typing.get_type_hints(cls, include_extras=True).items():
        if typing.get_origin(kind) is typing.ClassVar or kind is typing.ClassVar:
            continue
        fault = _fault_in(kind, inside | {cls})
        if fault:
            return f"is made of {cls.__name__}, whose {name} {fault}"
    return ""


def _fault_of_class(cls: type) -> str:
    if issubclass(cls, PurePath):
        return "is a path, which cannot be saved: write str, and make the Path of it where it is used"
    if is_number_type(cls):
        return f"is a {cls.__name__} of numpy, which cannot be saved: write float, int or bool"
    return (
        f"is of the class {cls.__name__}, which cannot be saved: write a @dataclass or a msgspec.Struct, or numbers,"
        " strings, lists, dicts and numpy arrays of numbers; what need not move along, on_start makes as an attribute"
        " of self"
    )


def _unwrapped(info: Any) -> Any:
    return _unwrapped(info.type) if isinstance(info, _I.Metadata) else info
