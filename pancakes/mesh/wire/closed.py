"""Classes of bodies that say all about what they contain: numbers, texts, bytes, and lists, maps and classes of these.

The decoder of such a class alone checks a body that arrives. A body that leaves needs no check before: where it does
not fit, the receiver finds out.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Final

import msgspec
from msgspec import inspect

from pancakes.runtime.foundation.codecs import type_info

_SCALARS: Final = (
    inspect.NoneType,
    inspect.BoolType,
    inspect.IntType,
    inspect.FloatType,
    inspect.StrType,
    inspect.BytesType,
    inspect.EnumType,
    inspect.LiteralType,
)


@lru_cache(maxsize=4096)
def is_closed(cls: type) -> bool:
    """Returns whether an instance has nothing but what its class says, and all of that travels."""
    try:
        return _is_closed(type_info(cls), ())
    except Exception:  # its annotations say nothing
        return False


def _is_closed(info: inspect.Type, within: tuple[type, ...]) -> bool:
    """Returns whether a value of a type has nothing but what its type says, to a depth that the type sets.

    Where a type leaves something open, a value may be nested too deep, or have an extension type in it.
    """
    match info:
        case inspect.Metadata(inner):
            return _is_closed(inner, within)
        case inspect.UnionType(types):
            return all(_is_closed(it, within) for it in types)
        case inspect.ListType(item) | inspect.VarTupleType(item):
            return _is_closed(item, within)
        case inspect.TupleType(items):
            return all(_is_closed(it, within) for it in items)
        case inspect.DictType(key, value):
            return isinstance(key, inspect.StrType) and _is_closed(value, within)
        case inspect.NamedTupleType(cls, parts):
            return cls not in within and all(_is_closed(it.type, (*within, cls)) for it in parts)
        case inspect.DataclassType(cls, parts) | inspect.StructType(cls, parts):
            return (
                cls not in within and _is_sent_whole(cls) and all(_is_closed(it.type, (*within, cls)) for it in parts)
            )
    return isinstance(info, _SCALARS)


def _is_sent_whole(cls: type) -> bool:
    if issubclass(cls, msgspec.Struct):
        return not cls.__struct_config__.omit_defaults
    # msgspec leaves out a field that no instance has for itself.
    return is_dataclass(cls) and all(field.init for field in fields(cls))
