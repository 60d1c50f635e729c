"""Whether a later version of a class, or of a module, means the same as an earlier one, wherever its lines stand. Pure.

Modules that are imported again make all of their classes again. A packet type that has not changed stays the class that
it was, so that drivers, services and waiting packets, which know that one, need not change with a task. What cannot be
compared is not known to be the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import Enum
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgspec

_OF_FIELDS: Final = frozenset(
    (
        "__annotations__",
        "__annotate__",
        "__annotate_func__",
        "__annotations_cache__",
        "__dataclass_fields__",
        "__dataclass_params__",
        "__slots__",
        "__match_args__",
    )
)
"""What is compared as fields, with their types and defaults."""
_INCIDENTAL: Final = frozenset(("__doc__", "__dict__", "__weakref__", "__firstlineno__", "__static_attributes__"))
_OF_IMPORT: Final = frozenset(
    (
        "__name__",
        "__doc__",
        "__package__",
        "__loader__",
        "__spec__",
        "__file__",
        "__cached__",
        "__builtins__",
        "__annotations__",
        "__annotate__",
        "__annotate_func__",
        "__conditional_annotations__",
    )
)
"""What each module has, whatever its author wrote."""
_OF_ENUMS: Final = frozenset(("_member_map_", "_value2member_map_", "_member_names_", "__new__", "_hashable_values_"))
"""What is compared as members, with their values."""
_Pairs = set[tuple[int, int]]


def differs(before: type, after: type, names_before: Mapping[str, Any]) -> bool:
    """Return whether a later version of a class differs from an earlier one in its fields, or in what it does.

    Classes that it uses must be the same ones: code that names those gets the later ones.

    Args:
        before: the class in use: a dataclass, or a `msgspec.Struct`.
        after: the later version.
        names_before: the names that the module of the class in use had, in which its annotations are read.
    """
    if before is after:
        return False
    try:
        return not _Comparison("").classes(before, after, names_before)
    except Exception:  # annotations and values may be anything
        return True


def module_differs(before: ModuleType, after: ModuleType) -> bool:
    """Return whether a later version of a module differs from an earlier one in anything that it defines.

    What it has from other modules must be the same.
    """
    names, names_after = _authored(before), _authored(after)
    try:
        return not (names.keys() == names_after.keys() and _Comparison(before.__name__).same(names, names_after))
    except Exception:  # a module may contain anything
        return True


def _authored(module: ModuleType) -> dict[str, Any]:
    return {name: value for name, value in sorted(vars(module).items()) if name not in _OF_IMPORT}


class _Comparison:
    """Compares values of two versions.

    Args:
        module: the module whose functions and classes are compared, instead of being the same ones; empty: none.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self._pairs: _Pairs = set()  # under way, or done: a class may name itself

    def same(self, before: Any, after: Any) -> bool:
        if before is after or (id(before), id(after)) in self._pairs:
            return True
        if type(before) is not type(after):
            return self._parts(before, after)
        match before:
            case FunctionType():
                return self._functions(before, after)
            case staticmethod() | classmethod():
                return self.same(before.__func__, after.__func__)
            case property():
                return all(self.same(getattr(before, it), getattr(after, it)) for it in ("fget", "fset", "fdel"))
            case type() if get_origin(before) is None:
                own = self._module != "" and before.__module__ == after.__module__ == self._module
                return own and self.classes(before, after, None)
            case list() | tuple():
                return len(before) == len(after) and all(map(self.same, before, after))
            case dict():
                return list(before) == list(after) and all(map(self.same, before.values(), after.values()))
            case MemberDescriptorType() | GetSetDescriptorType():
                return bool(before.__name__ == after.__name__)
        if parts := get_args(before):
            return self.same(get_origin(before), get_origin(after)) and self.same(parts, get_args(after))
        return bool(before == after)

    def _parts(self, before: Any, after: Any) -> bool:
        """Compare instances of two versions of a class, which never are equal."""
        if not self.same(type(before), type(after)):
            return False
        if isinstance(before, Enum):
            return bool(before.name == after.name)
        names = [field[0] for field in _fields_of(type(before))[1:]]
        return names != [] and all(self.same(getattr(before, name), getattr(after, name)) for name in names)

    def classes(self, before: type, after: type, names_before: Mapping[str, Any] | None) -> bool:
        self._pairs.add((id(before), id(after)))
        names = dict(names_before) if names_before is not None else None
        return (
            before.__qualname__ == after.__qualname__
            and self.same(before.__bases__, after.__bases__)
            and self.same(
                get_type_hints(before, names, include_extras=True), get_type_hints(after, include_extras=True)
            )
            and self.same(_fields_of(before), _fields_of(after))
            and self.same(_rest_of(before), _rest_of(after))
        )

    def _functions(self, before: FunctionType, after: FunctionType) -> bool:
        if self._module and not before.__module__ == after.__module__ == self._module:
            return False  # it has it from a module that was imported again, and has changed
        self._pairs.add((id(before), id(after)))
        code = before.__code__
        return (
            _code_of(code) == _code_of(after.__code__)
            and self.same(before.__defaults__, after.__defaults__)
            and self.same(before.__kwdefaults__, after.__kwdefaults__)
            and self.same(vars(before), vars(after))
            and self.same(_cells_of(before), _cells_of(after))
            and all(
                name not in before.__globals__ or self.same(before.__globals__[name], after.__globals__[name])
                for name in sorted(_names_in(code))
            )
        )


def _cells_of(function: FunctionType) -> list[Any]:
    return [cell.cell_contents for cell in function.__closure__ or ()]


def _names_in(code: CodeType) -> set[str]:
    """Return the names that a function, and those within it, may take from their module."""
    return set(code.co_names).union(*(_names_in(it) for it in code.co_consts if isinstance(it, CodeType)))


def _fields_of(cls: type) -> list[Any]:
    """Return the fields of a class with their defaults, and how it is made."""
    if issubclass(cls, msgspec.Struct):
        config = cls.__struct_config__
        made = tuple(getattr(config, name) for name in dir(config) if not name.startswith("_"))
        return [made, *((it.name, it.default, it.default_factory) for it in msgspec.structs.fields(cls))]
    if dataclasses.is_dataclass(cls):
        fields = dataclasses.fields(cls)
        made = (repr(getattr(cls, "__dataclass_params__", None)),)
        return [made, *((it.name, it.default, it.default_factory) for it in fields)]
    if issubclass(cls, Enum):
        return [(name, it.value) for name, it in cls.__members__.items()]
    return []


def _rest_of(cls: type) -> dict[str, Any]:
    """Return what a class has besides its fields: methods, properties, constants."""
    names: set[str] = set(_OF_FIELDS | _INCIDENTAL)
    if issubclass(cls, msgspec.Struct):
        names.update(cls.__struct_fields__)
    elif dataclasses.is_dataclass(cls):
        names.update(it.name for it in dataclasses.fields(cls))
    elif issubclass(cls, Enum):
        names |= {*_OF_ENUMS, *cls.__members__}
    return {
        name: value
        for name, value in sorted(vars(cls).items())
        if name not in names and not name.startswith(("__struct_", "__msgspec"))
    }


def _code_of(code: CodeType) -> tuple[Any, ...]:
    """Return what a function does, without its file and its lines."""
    constants = tuple(_code_of(it) if isinstance(it, CodeType) else (type(it).__name__, it) for it in code.co_consts)
    arguments = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return (code.co_code, code.co_exceptiontable, constants, names, arguments, code.co_flags)
