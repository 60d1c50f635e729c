"""A module of the product with another text in some places: what a broken variant is."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType


def edited(module: ModuleType, story: str, *edits: tuple[str, str], own_classes: bool = False) -> ModuleType:
    """Returns a module with other texts in some places.

    Args:
        module: the module, which stays as it is.
        story: what the variant does wrongly, for messages.
        edits: text that stands in it, once, and text instead.
        own_classes: whether its classes may be edited too; else its values are of the product's own classes.

    Raises:
        LookupError: a text does not stand there exactly once.
    """
    text = inspect.getsource(module)
    for old, new in edits:
        count = text.count(old)
        if count != 1:
            raise LookupError(f"the mutant {story!r} finds its text {count} times: {old}")
        text = text.replace(old, new)
    variant = ModuleType(f"{module.__name__} without {story}")
    sys.modules[variant.__name__] = variant  # where msgspec looks for the types of its classes
    exec(compile(text, f"<mutant of {module.__name__}>", "exec"), variant.__dict__)
    for name, value in vars(module).items():
        if isinstance(value, type) and not own_classes:
            setattr(variant, name, value)
    return variant
