"""Names that are Pancakes' own in the classes that its users derive from.

A method `pause`, or `_start`, would stand in for the one that Pancakes calls, and nothing would say so: a class that
gives such a name to something of its own is refused when it is made.
"""

from __future__ import annotations

import dis
import inspect
from collections.abc import Collection, Iterator
from functools import cache, cached_property, partial, partialmethod, singledispatchmethod
from types import CodeType, FunctionType
from typing import Any, Final

from pancakes.errors import ClassError
from pancakes.runtime.foundation.source_place import place_of_field, place_of_function
from pancakes.runtime.foundation.user_classes import is_own, parts_of

_VERBS: Final = {"STORE_ATTR": "sets", "DELETE_ATTR": "deletes"}
_HOLD_FUNCTIONS: Final = (
    *(FunctionType, property, classmethod, staticmethod, type(cache(len))),
    *(cached_property, partial, partialmethod, singledispatchmethod),
)


def check_own_names(cls: type, base: type, hooks: Collection[str], kept: Collection[str] = ()) -> None:
    """Refuses a class that gives a name of Pancakes to something of its own.

    Args:
        cls: the class that is made.
        base: the base that users derive from; what it has is Pancakes', and what is between the two is not.
        hooks: the names that a class may give a meaning of its own.
        kept: the attributes that its methods may set.

    Raises:
        ClassError: names the file, the line and the name, and the hooks.
    """
    if is_own(cls):
        return
    own = _names_of(base) - set(hooks)
    for part in parts_of(cls):
        _check(part, base, own, hooks, kept)


def _check(cls: type, base: type, own: frozenset[str], hooks: Collection[str], kept: Collection[str]) -> None:
    what = f"Pancakes' own in a {base.__name__}: give it another name"
    for name, value in vars(cls).items():
        if name in own:
            function = next(iter(_functions(value)), None)
            place = place_of_function(inspect.unwrap(function)) if function else place_of_field(cls)
            open_to = ", ".join(sorted(it for it in hooks if it.startswith("on_")))
            also = f" (its hooks are {open_to})" if open_to and callable(value) else ""
            raise ClassError(f"{place}: {cls.__qualname__}.{name} would replace a name that is {what}{also}")
        for function in () if isinstance(value, staticmethod) else _functions(value):
            if own.isdisjoint(_names_in(function.__code__)):
                continue
            for stored, line, verb in _stores(function):
                if stored in own and not (stored in kept and verb == "sets"):
                    place = f"{function.__code__.co_filename}:{line}"
                    raise ClassError(f"{place}: {cls.__qualname__}.{name} {verb} self.{stored}, which is {what}")


def _functions(value: Any) -> Iterator[FunctionType]:
    """The functions that something in a class is made of: those of a property, and what a decorator wraps."""
    if isinstance(value, FunctionType):
        yield value
    for name in ("fget", "fset", "fdel", "func", "__func__", "__wrapped__"):
        inner = getattr(value, name, None)
        if isinstance(value, _HOLD_FUNCTIONS) and inner is not None:
            yield from _functions(inner)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names_in(inner)


@cache
def _names_of(base: type) -> frozenset[str]:
    """All names that a class of Pancakes has or gives its instances, without those that Python gives all classes."""
    names: set[str] = set()
    for one in base.__mro__[:-1]:
        names.update(one.__dict__)
        for function in vars(one).values():
            if isinstance(function, FunctionType):
                names.update(stored for stored, _, _ in _stores(function))
    return frozenset(name for name in names if not (name.startswith("__") and name.endswith("__")))


def _stores(function: FunctionType) -> Iterator[tuple[str, int, str]]:
    """The attributes that a method gives or takes from its first argument, with the lines, and which it does."""
    code = function.__code__
    if code.co_argcount:
        yield from _stores_in(code, code.co_varnames[0])


def _stores_in(code: CodeType, first: str) -> Iterator[tuple[str, int, str]]:
    line = code.co_firstlineno
    before: dis.Instruction | None = None
    copied: dis.Instruction | None = None
    augments_self = False
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("CACHE", "EXTENDED_ARG"):
            continue
        line = _line(instruction) or line
        verb = _VERBS.get(instruction.opname)
        if before is None:
            pass
        elif verb is not None:
            if _loads(before, first) or (before.opname == "SWAP" and augments_self):
                yield instruction.argval, line, verb
        elif instruction.opname == "LOAD_ATTR" and before.opname == "COPY" and before.argval == 1:
            # `self.x += 1` keeps a copy of self below what it computes, and brings it to the top at the end.
            augments_self = copied is not None and _loads(copied, first)
        before, copied = instruction, before
    for inner in code.co_consts:
        if isinstance(inner, CodeType) and first in inner.co_freevars:
            yield from _stores_in(inner, first)


def _loads(instruction: dis.Instruction, name: str) -> bool:
    """Whether an instruction leaves a variable on top; some of newer Pythons load two at once."""
    loaded: Any = instruction.argval
    if isinstance(loaded, tuple):
        loaded = loaded[-1]
    opname = instruction.opname
    return "LOAD" in opname and ("FAST" in opname or "DEREF" in opname) and loaded == name


def _line(instruction: dis.Instruction) -> int | None:
    return instruction.positions.lineno if instruction.positions is not None else None
