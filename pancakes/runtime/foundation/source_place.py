"""Where a class or a function is written: `robot.py:12`, for sentences that people read."""

from __future__ import annotations

import ast
import inspect
import linecache
import sys
import textwrap
from collections.abc import Callable
from typing import Any


def place_of_function(function: Callable[..., Any]) -> str:
    """Returns the file and line of a function's `def`; its module where it has none, as what is built into Python."""
    code = getattr(function, "__code__", None)
    if code is None:
        return str(getattr(function, "__module__", None) or "a module")
    first: int = code.co_firstlineno  # of its first decorator, where it has one
    words = (f"def {code.co_name}", f"async def {code.co_name}")
    for number, line in enumerate(linecache.getlines(code.co_filename)[first - 1 :]):
        if line.strip().startswith(words):
            return f"{code.co_filename}:{first + number}"
    return f"{code.co_filename}:{first}"


def place_of_field(cls: type, field: str = "") -> str:
    """Returns the file and line of a field of a class, or of the class; its module where there is no text of it."""
    for owner in cls.__mro__ if field else (cls,):
        if field and field not in inspect.get_annotations(owner):
            continue
        try:
            lines, first = inspect.getsourcelines(owner)
        except (OSError, TypeError):
            return _module_of(owner)
        return f"{inspect.getsourcefile(owner)}:{first + _line_of(field, lines)}"
    return _module_of(cls)


def _line_of(field: str, lines: list[str]) -> int:
    """Returns in which line of a class's text, from 0, a field is declared; 0 where none is found."""
    try:
        (defined,) = ast.parse(textwrap.dedent("".join(lines))).body
    except (SyntaxError, ValueError):
        return 0
    for part in getattr(defined, "body", ()):
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name) and part.target.id == field:
            return part.lineno - 1
    return 0 if field else max(0, getattr(defined, "lineno", 1) - 1)


def _module_of(cls: type) -> str:
    module = sys.modules.get(cls.__module__)
    return str(getattr(module, "__file__", None) or cls.__module__)
