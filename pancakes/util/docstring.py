"""Read docstrings for people, also if Python drops them (`python -OO`, `PYTHONOPTIMIZE=2`)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


def docstring_of(thing: type | Callable[..., Any]) -> str:
    """Return the docstring of a class or function, without its indent; empty if it has none."""
    doc = vars(thing).get("__doc__") if isinstance(thing, type) else thing.__doc__
    if isinstance(thing, type) and doc and doc.startswith(f"{thing.__name__}("):
        doc = ""  # the docstring that @dataclass generates
    if doc or sys.flags.optimize < 2:
        from inspect import cleandoc

        return cleandoc(doc) if doc else ""
    return _in_source(thing)


def _in_source(thing: type | Callable[..., Any]) -> str:
    import ast
    import inspect
    import textwrap

    try:
        (defined,) = ast.parse(textwrap.dedent(inspect.getsource(thing))).body
    except (OSError, TypeError, SyntaxError, ValueError):  # its source is missing
        return ""
    found = ast.get_docstring(defined) if isinstance(defined, (ast.FunctionDef, ast.ClassDef)) else None
    return found or ""
