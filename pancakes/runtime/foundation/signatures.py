"""What a method must look like that Pancakes calls: found out when its class is made, and not when it is called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

from pancakes.errors import ClassError
from pancakes.runtime.foundation.source_place import place_of_function

_OWN: Final = "pancakes."
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

    Raises:
        ClassError: one is `async def`, does nothing when it is called, or takes other arguments.
    """
    for name, function in vars(cls).items():
        if name.startswith("_") or not inspect.isfunction(function):
            continue
        original = next((vars(base)[name] for base in cls.__mro__[1:] if name in vars(base)), None)
        if not inspect.isfunction(original) or not f"{original.__module__}.".startswith(_OWN):
            continue
        _check_override(function, original)


def _check_override(function: Callable[..., Any], original: Callable[..., Any]) -> None:
    write = f"def {function.__name__}({', '.join(map(str, _bare(original)))})"
    if not inspect.iscoroutinefunction(original) and inspect.iscoroutinefunction(function):
        check_runs(function, write)
    if original.__annotations__.get("return") in (None, "None"):
        check_runs(function, write)
    count = _plain_count(function)
    if count is not None and count == _plain_count(original):
        return
    parameters = inspect.signature(original).parameters.values()
    positional = [it for it in parameters if it.kind in (it.POSITIONAL_ONLY, it.POSITIONAL_OR_KEYWORD)]
    named = [it.name for it in parameters if it.kind is it.KEYWORD_ONLY]
    if not takes(function, len(positional), named):
        raise ClassError(
            f"{_head(function)} takes {_parameters(function)}, and stands in for"
            f" {original.__qualname__}{_parameters(original)}, which Pancakes calls: write `{write}`"
        )


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
