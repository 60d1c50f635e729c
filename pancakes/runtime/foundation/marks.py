"""What `@on` and `@every` leave at a method, and where they may not stand."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

from pancakes.errors import ClassError
from pancakes.runtime.foundation.source_place import place_of_function
from pancakes.runtime.foundation.user_classes import given_in, is_own

SUBSCRIPTIONS: Final = "__subscriptions__"
"""The attribute of a method that `@on` leaves."""
PERIOD: Final = "__period__"
"""The attribute of a method that `@every` leaves."""


def marks_of(function: Any) -> str:
    """Returns which of the two stands at a function, as a person would write it; empty: none does."""
    if hasattr(function, PERIOD):
        return "@every"
    return "@on" if hasattr(function, SUBSCRIPTIONS) else ""


def check_marks(cls: type, reacts: str = "") -> None:
    """Refuses a class with `@on` or `@every` where it would do nothing, or would have a hook called a second time.

    Args:
        cls: the class.
        reacts: what the class is, if it reacts to no packet and no time: `a driver`; empty: it reacts.

    Raises:
        ClassError: names the file, the line and the method.
    """
    for part, name, value in given_in(cls):
        function = _inner(value)
        mark = marks_of(function)
        if not mark:
            continue
        head = f"{place_of_function(function)}: {part.__qualname__}.{name}"
        if reacts:
            raise ClassError(
                f"{head} is decorated with {mark}, and {reacts} is called by what uses it: only the methods of tasks"
                f" and services react to packets and time. Leave {mark} out"
            )
        if function is not value:
            raise ClassError(
                f"{head} is decorated with {mark}, and is a {type(value).__name__}, which nothing would call: leave"
                f" @{type(value).__name__} out"
            )
        behind = cls.__mro__[cls.__mro__.index(part) + 1 :]
        hook = next((vars(it)[name] for it in behind if is_own(it) and name in vars(it)), None)
        if hook is not None and not marks_of(hook):
            raise ClassError(
                f"{head} is decorated with {mark}, and Pancakes calls {name} itself at its own time: give what"
                f" {mark} calls a method of its own, which {name} may call too"
            )


def _inner(value: Any) -> Any:
    if isinstance(value, (staticmethod, classmethod)):
        return value.__func__
    if isinstance(value, property):
        return value.fget
    return value.func if isinstance(value, cached_property) else value
