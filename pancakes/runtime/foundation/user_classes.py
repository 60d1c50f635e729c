"""Which part of a class its author wrote: the class, and what is mixed into it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

_OWN: Final = "pancakes."
MADE_AS: Final = "_made_as"
"""The attribute of each base that users derive from; a class that has it was judged when it was made."""


def is_own(cls: type) -> bool:
    """Returns whether a class is Pancakes' own."""
    return f"{cls.__module__}.".startswith(_OWN)


def parts_of(cls: type) -> list[type]:
    """Returns a class, and what is mixed into it that was not judged when it was made."""
    own = [it for it in cls.__mro__ if is_own(it)]
    mixed_in = [it for it in cls.__mro__[1:] if not hasattr(it, MADE_AS)]
    return [cls, *(it for it in mixed_in if not any(issubclass(mine, it) for mine in own))]


def owner_of(cls: type, name: str) -> type | None:
    """Returns the class that a class has an attribute from; None: it has none of this name."""
    return next((it for it in cls.__mro__ if name in vars(it)), None)


def given_in(cls: type) -> Iterator[tuple[type, str, Any]]:
    """Yields what the author of a class gives it: in which class it stands, its name, and what it is."""
    for part in parts_of(cls):
        for name, value in vars(part).items():
            if part is cls or owner_of(cls, name) is part:
                yield part, name, value
