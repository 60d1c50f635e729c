"""What a method must look like that Pancakes calls: found out when its class is made, and not when it is called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Sequence
from types import FunctionType
from typing import Any, Final

from pancakes.errors import ClassError
from pancakes.runtime.foundation.source_place import place_of_field, place_of_function
from pancakes.runtime.foundation.user_classes import given_in, is_own

_STARRED: Final = inspect.CO_VARARGS | inspect.CO_VARKEYWORDS


def check_called(function: Any, given: Sequence[str], caller: str, write: str) -> None:
    """Refuses what cannot be called as it will be.

    Args:
        function: a function, or whatever else can be called.
        given: the names of what it is given, in order; `self` among them.
        caller: what calls it and with what, as a clause: `@every calls it with a Tick`.
        write: what to write instead: `def blink(self, tick: Tick) -> None`.

    Raises:
        ClassError: it is no function, is `async def`, has a `yield`, or takes other arguments. The sentence names its
            file and line.
    """
    if isinstance(function, (staticmethod, classmethod)):
        raise ClassError(
            f"{_head(function.__func__)} is a {type(function).__name__}, and {caller} and the task: write `{write}`"
        )
    if not callable(function):
        raise ClassError(f"{function!r} is no method, and {caller}: write `{write}`")
    check_runs(function, write)
    if not takes(function, len(given)):
        raise ClassError(f"{_head(function)} takes {_parameters(function)}, and {caller}: write `{write}`")


def check_runs(function: Any, write: str) -> None:
    """Refuses a function that does nothing when it is called, because the caller would have to await or iterate it.

    Args:
        function: what is called.
        write: what to write instead; empty: `def` and no more is said.

    Raises:
        ClassError: it is `async def`, or has a `yield`.
    """
    if inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function):
        raise ClassError(
            f"{_head(function)} is `async def`, and an actor awaits nothing: write"
            f" `{write or 'def'}`, and let what it would wait for come as a packet (@on) or at a time (@every, after)"
        )
    if inspect.isgeneratorfunction(function):
        raise ClassError(
            f"{_head(function)} has a `yield`, so that a call of it does nothing: write `{write or 'def'}` without it"
        )


def check_overrides(cls: type) -> None:
    """Refuses methods of a class that stand in for a method of Pancakes, and cannot be called as that one is.

    Those that are mixed into it are judged as well.

    Raises:
        ClassError: one is no function, is `async def`, does nothing when it is called, or takes other arguments.
    """
    for part, name, value in given_in(cls):
        if name.startswith("_"):
            continue
        behind = cls.__mro__[cls.__mro__.index(part) + 1 :]
        original = next((vars(base)[name] for base in behind if is_own(base) and name in vars(base)), None)
        if isinstance(original, (FunctionType, classmethod, staticmethod)):
            _check_override(part, name, value, original)


def definition_of(original: Any, name: str = "") -> str:
    """Returns the `def` of a method, as a person would write it in its place."""
    function = getattr(original, "__func__", original)
    parameters = ", ".join(map(str, _bare(function))) if callable(function) else "self"
    mark = f"@{type(original).__name__} " if isinstance(original, (classmethod, staticmethod)) else ""
    return f"{mark}def {name or function.__name__}({parameters})"


def _check_override(part: type, name: str, value: Any, original: Any) -> None:
    write, meant = definition_of(original, name), getattr(original, "__func__", original)
    function = getattr(value, "__func__", value)
    if type(value) is not type(original) or not isinstance(function, FunctionType):
        raise ClassError(
            f"{_place(part, function)}: {part.__qualname__}.{name} is {_kind(value)}, and stands in for"
            f" {meant.__qualname__}{_parameters(meant)}, which Pancakes calls: write `{write}`"
        )
    if not inspect.iscoroutinefunction(meant) and inspect.iscoroutinefunction(function):
        check_runs(function, write)
    if meant.__annotations__.get("return") in (None, "None"):
        check_runs(function, write)
    count = _plain_count(function)
    if count is not None and count == _plain_count(meant):
        return
    parameters = inspect.signature(meant).parameters.values()
    positional = [it for it in parameters if it.kind in (it.POSITIONAL_ONLY, it.POSITIONAL_OR_KEYWORD)]
    named = [it.name for it in parameters if it.kind is it.KEYWORD_ONLY]
    if not takes(function, len(positional), named):
        raise ClassError(
            f"{_head(function)} takes {_parameters(function)}, and stands in for"
            f" {meant.__qualname__}{_parameters(meant)}, which Pancakes calls: write `{write}`"
        )


def _place(part: type, function: Any) -> str:
    function = getattr(function, "fget", None) or function
    return place_of_function(function) if isinstance(function, FunctionType) else place_of_field(part)


def _kind(value: Any) -> str:
    """What stands in a class in the place of a method."""
    if isinstance(value, (FunctionType, classmethod, staticmethod, property, type)) or callable(value):
        return f"a {type(value).__name__}"
    return repr(value)


def _plain_count(function: Any) -> int | None:
    """How many parameters a function has; None where they are not all plain ones, and it takes a closer look."""
    code = getattr(function, "__code__", None)
    if code is None or code.co_kwonlyargcount or code.co_posonlyargcount or code.co_flags & _STARRED:
        return None
    return int(code.co_argcount)


def takes(function: Callable[..., Any], count: int, named: Collection[str] = ()) -> bool:
    """Returns whether a function can be called with so many arguments and those names."""
    if not named and _plain_count(function) == count:
        return True  # nearly all; a signature takes 10 µs
    try:
        signature = inspect.signature(function, follow_wrapped=False)
    except (TypeError, ValueError):
        return True  # what is built into Python does not tell
    try:
        signature.bind(*range(count), **dict.fromkeys(named))
    except TypeError:
        return False
    return True


def _head(function: Any) -> str:
    name = str(getattr(function, "__qualname__", "") or repr(function)).rpartition("<locals>.")[2]
    return f"{place_of_function(function)}: {name}"


def _parameters(function: Callable[..., Any]) -> str:
    return f"({', '.join(it.name for it in inspect.signature(function, follow_wrapped=False).parameters.values())})"


def _bare(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """The parameters as a person would write them, without their types."""
    return [it.replace(annotation=it.empty) for it in inspect.signature(function).parameters.values()]
