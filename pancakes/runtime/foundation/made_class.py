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
    """

    given: tuple[str, ...]
    what: str
    instead: str


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
        _check_dataclass(owner, made)
        head = f"{place_of_function(function)}: {owner.__qualname__}.{name}"
        if not takes(function, 1, made.given):
            raise ClassError(
                f"{head} takes {inspect.signature(function, follow_wrapped=False)}, and it is Pancakes that makes"
                f" {made.what}: leave it out, and write {made.instead}"
            )
        if not _calls_on(function, name):
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
    for part in cls.__mro__:
        if not is_own(part) and part in (owner_of(cls, "__init__"), owner_of(cls, "__hash__")):
            _check_dataclass(part, getattr(cls, MADE_AS))
    check_made(cls)
    lacking = sorted(getattr(cls, "__abstractmethods__", ()))
    if lacking:
        wanted = ", ".join(f"`{definition_of(getattr(cls, name), name)}`" for name in lacking)
        raise ClassError(f"{place_of_field(cls)}: {cls.__qualname__} lacks {', '.join(lacking)}: write {wanted}")


def check_instance(made: object, attribute: str) -> None:
    """Refuses what came of a class whose `__init__` did not go on to that of Pancakes.

    Args:
        made: the instance.
        attribute: what that gives each instance.

    Raises:
        ClassError: it has it not.
    """
    cls = type(made)
    if attribute in vars(made) or not hasattr(cls, MADE_AS):
        return
    head = f"{place_of_field(cls)}: {cls.__qualname__}.__init__"
    raise ClassError(_silent(head, "__init__", getattr(cls, MADE_AS)))


def _silent(head: str, name: str, made: Made) -> str:
    given = "cls" if name == "__new__" else "*args, **others"
    return (
        f"{head} does not call `super().{name}({given})`, and {made.what} could not work: leave it out, and write"
        f" {made.instead}"
    )


def _check_dataclass(cls: type, made: Made) -> None:
    if "__dataclass_fields__" in vars(cls):
        raise ClassError(
            f"{place_of_field(cls)}: {cls.__qualname__} is decorated with @dataclass, and it is Pancakes that makes"
            f" {made.what}: leave it out, let what may be set stand in `@dataclass class Settings`, and write"
            f" {made.instead}"
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
