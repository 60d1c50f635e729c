"""Names that are Pancakes' own in the classes that its users derive from.

A method `pause`, or `_start`, would stand in for the one that Pancakes calls, and nothing would say so: a class that
gives such a name to something of its own is refused when it is made.
"""

from __future__ import annotations

import dis
import inspect
from collections.abc import Collection, Iterator
from functools import cache
from types import FunctionType
from typing import Any, Final

from pancakes.errors import ClassError
from pancakes.runtime.foundation.signatures import takes
from pancakes.runtime.foundation.source_place import place_of_field, place_of_function

_OWN: Final = "pancakes."


def is_own(cls: type) -> bool:
    """Returns whether a class is Pancakes' own, for which these names are meant."""
    return f"{cls.__module__}.".startswith(_OWN)


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
    _check(cls, base, own, hooks, kept)
    for mixed_in in cls.__mro__[1:]:
        if not issubclass(mixed_in, base) and not issubclass(base, mixed_in) and not is_own(mixed_in):
            _check(mixed_in, base, own, hooks, kept)


def _check(cls: type, base: type, own: frozenset[str], hooks: Collection[str], kept: Collection[str]) -> None:
    what = f"Pancakes' own in a {base.__name__}: give it another name"
    for name, value in vars(cls).items():
        function = inspect.unwrap(value) if callable(value) else getattr(value, "fget", None) or value
        if name in own:
            place = place_of_function(function) if isinstance(function, FunctionType) else place_of_field(cls)
            open_to = ", ".join(sorted(it for it in hooks if it.startswith("on_")))
            also = f" (its hooks are {open_to})" if open_to and isinstance(function, FunctionType) else ""
            raise ClassError(f"{place}: {cls.__qualname__}.{name} would replace a name that is {what}{also}")
        if isinstance(function, FunctionType) and not own.isdisjoint(function.__code__.co_names):
            for stored, line in _stores(function):
                if stored in own and stored not in kept:
                    place = f"{function.__code__.co_filename}:{line}"
                    raise ClassError(f"{place}: {cls.__qualname__}.{name} sets self.{stored}, which is {what}")


def check_made(cls: type, given: Collection[str], made: str, instead: str) -> None:
    """Refuses a class whose `__init__` cannot be called as Pancakes calls it.

    Args:
        cls: the class that is made.
        given: the names of the arguments.
        made: what it is, as in `a task`.
        instead: where what its author wants to do belongs.

    Raises:
        ClassError: says so, with the file and line.
    """
    function = vars(cls).get("__init__")
    if is_own(cls) or function is None or takes(function, 1, given):
        return
    named = str(inspect.signature(function))
    raise ClassError(
        f"{place_of_function(function)}: {cls.__qualname__}.__init__ takes {named}, and it is Pancakes that makes"
        f" {made}: leave it out, and write {instead}"
    )


@cache
def _names_of(base: type) -> frozenset[str]:
    """All names that a class of Pancakes has or gives its instances, without those that Python gives all classes."""
    names: set[str] = set()
    for one in base.__mro__[:-1]:
        names.update(one.__dict__)
        for function in vars(one).values():
            if isinstance(function, FunctionType):
                names.update(stored for stored, _ in _stores(function))
    return frozenset(name for name in names if not (name.startswith("__") and name.endswith("__")))


def _stores(function: FunctionType) -> Iterator[tuple[str, int]]:
    """The attributes that a method gives its first argument, with the lines in which it does."""
    code = function.__code__
    if not code.co_argcount:
        return
    first, before, line = code.co_varnames[0], None, code.co_firstlineno
    for instruction in dis.get_instructions(code):
        line = _line(instruction) or line
        if instruction.opname == "STORE_ATTR" and before is not None and _loads(before, first):
            yield instruction.argval, line
        if instruction.opname not in ("CACHE", "EXTENDED_ARG"):
            before = instruction


def _loads(instruction: dis.Instruction, name: str) -> bool:
    """Whether an instruction leaves a variable on top; some of newer Pythons load two at once."""
    loaded: Any = instruction.argval
    if isinstance(loaded, tuple):
        loaded = loaded[-1]
    return "LOAD" in instruction.opname and loaded == name


def _line(instruction: dis.Instruction) -> int | None:
    return instruction.positions.lineno if instruction.positions is not None else None
