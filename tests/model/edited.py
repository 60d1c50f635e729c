"""A module of the product with another text in one place: what a broken variant is."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType


def edited(module: ModuleType, story: str, old: str, new: str) -> ModuleType:
    """Returns a module with `new` in the place of `old`.

    Args:
        module: the module, which stays as it is.
        story: what the variant does wrongly, for messages.
        old: text that stands in it, once.
        new: text instead.

    Raises:
        LookupError: the text does not stand there exactly once.
    """
    text = inspect.getsource(module)
    count = text.count(old)
    if count != 1:
        raise LookupError(f"the mutant {story!r} finds its text {count} times: {old}")
    variant = ModuleType(f"{module.__name__} without {story}")
    sys.modules[variant.__name__] = variant  # where msgspec looks for the types of its classes
    exec(compile(text.replace(old, new), f"<mutant of {module.__name__}>", "exec"), variant.__dict__)
    for name, value in vars(module).items():
        if isinstance(value, type):  # its values are to be of the product's own classes
            setattr(variant, name, value)
    return variant
