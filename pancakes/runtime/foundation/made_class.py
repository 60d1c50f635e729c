"""Whether Pancakes can make an instance of a class that a user wrote: found out when it is loaded, at the latest."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from types import CodeType, FunctionType
from typing import Any, Final, NamedTuple

from pancakes.errors import ClassError
from pancakes.runtime.foundation.signatures import definition_of, takes
from pancakes.runtime.foundation.source_place import place_of_field, place_of_function
from pancakes.runtime.foundation.user_classes import MADE_AS, is_own, owner_of

_MAKERS: Final = ("__new__", "__init__")


class Made(NamedTuple):
    """How Pancakes makes an instance.

    Attributes:
        given: the names of the arguments.
        what: what it is, as in `a task`.
        instead: where what its author wants to do belongs.
        gives: an attribute that the `__init__` of Pancakes gives each instance, and that nothing works without; empty:
            it may be left out.
    """

    given: tuple[str, ...]
    what: str
    instead: str
    gives: str = ""


def check_made(cls: type) -> None:
    """Refuses a class that cannot be called as Pancakes calls it.

    Raises:
        ClassError: says so, with the file and line.
    """
    made: Made = getattr(cls, MADE_AS)
    for name in _MAKERS:
        owner = owner_of(cls, name)
        if owner is None or is_own(owner):
            continue
        function = getattr(vars(owner)[name], "__func__", vars(owner)[name])
        if not isinstance(function, FunctionType):
            continue
        fits = takes(function, 1, made.given)
        if fits and (not made.gives or _calls_on(function, name)):
            continue
        _check_dataclass(owner, made)
        head = f"{place_of_function(function)}: {owner.__qualname__}.{name}"
        if not fits:
            raise ClassError(
                f"{head} takes {inspect.signature(function, follow_wrapped=False)}, and it is Pancakes that makes"
                f" {made.what}: leave it out, and write {made.instead}"
            )
        raise ClassError(_silent(head, name, made))


def check_loaded(cls: Any) -> None:
    """Refuses a class that came to be unfit after it was made, by a decorator, or that is only half of one.

    Args:
        cls: what was loaded; all but a class of a user that Pancakes makes is passed over.

    Raises:
        ClassError: it is a dataclass, lacks methods, or cannot be called as Pancakes calls it.
    """
    if not isinstance(cls, type) or is_own(cls) or not hasattr(cls, MADE_AS):
        return
    check_made(cls)
    made: Made = getattr(cls, MADE_AS)
    compared = owner_of(cls, "__hash__")
    if made.gives and compared is not None:
        _check_dataclass(compared, made)  # it takes the hash away, by which actors are known
    lacking = sorted(getattr(cls, "__abstractmethods__", ()))
    if lacking:
        wanted = ", ".join(f"`{definition_of(getattr(cls, name), name)}`" for name in lacking)
        raise ClassError(f"{place_of_field(cls)}: {cls.__qualname__} lacks {', '.join(lacking)}: write {wanted}")


def check_instance(cls: Any, instance: object) -> None:
    """Refuses what came of a class whose `__init__` did not go on to that of Pancakes.

    Args:
        cls: what was called; all but a class that Pancakes makes is passed over.
        instance: what came of it.

    Raises:
        ClassError: it is no instance, or has not got that.
    """
    made: Made | None = getattr(cls, MADE_AS, None)
    if made is None or made.gives in getattr(instance, "__dict__", ()):
        return
    name = "__init__" if isinstance(instance, cls) else "__new__"
    raise ClassError(_silent(f"{place_of_field(cls)}: {cls.__qualname__}.{name}", name, made))


def _silent(head: str, name: str, made: Made) -> str:
    given = "cls" if name == "__new__" else "*args, **others"
    return (
        f"{head} does not call `super().{name}({given})`, and {made.what} could not work: leave it out, and write"
        f" {made.instead}"
    )


def _check_dataclass(cls: type, made: Made) -> None:
    if "__dataclass_fields__" in vars(cls):
        has_settings = made.gives or "settings" in made.given
        instead = f"declare what may be set in `@dataclass class Settings`, and write {made.instead}"
        raise ClassError(
            f"{place_of_field(cls)}: {cls.__qualname__} is decorated with @dataclass, and it is Pancakes that makes"
            f" {made.what}: leave that out, {instead if has_settings else 'or give its fields defaults'}"
        )


def _calls_on(function: FunctionType, name: str) -> bool:
    """Whether a method may call that of the next class; one that calls what it was given, as a decorator, may."""
    code = inspect.unwrap(function).__code__
    return name in _names_in(code) or any(it != "__class__" for it in code.co_freevars)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names_in(inner)
