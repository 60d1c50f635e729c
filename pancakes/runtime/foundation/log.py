"""Lines for people, as Python's logging has it: `self.log.warning("no echo for 2 s")`."""

from __future__ import annotations

import dis
import sys
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType
from typing import Any, Final, NoReturn

from pancakes.errors import ClassError, PancakesError, traceback_of
from pancakes.runtime.foundation.suggestion import did_you_mean
from pancakes.runtime.foundation.user_classes import given_in

Say = Callable[[str, str, str], None]
"""Takes a level, a line and a traceback."""
LEVELS: Final = ("debug", "info", "warning", "error")
_METHODS: Final = (*LEVELS, "exception")
_MEANT: Final = frozenset((*LEVELS, "warn", "err", "critical", "fatal", "notice", "trace", "verbose"))
"""What other programs call their levels."""


class Log:
    """Publishes lines for people on the channel `log`. Any thread.

    Args:
        say: takes a level, a line and a traceback.
    """

    __slots__ = ("_say",)

    def __init__(self, say: Say) -> None:
        self._say = say

    def __call__(self, level: str, text: str, traceback: str = "") -> None:
        """Says a line, if its level is not known before.

        Args:
            level: debug, info, warning or error.
            text: the line.
            traceback: if it tells of a failure, what `pancakes.errors.traceback_of` returns; the log file has it.

        Raises:
            PancakesError: there is no such level.
        """
        if level not in LEVELS:
            raise PancakesError(f"the log has no level {level!r}{did_you_mean(level, LEVELS, _only(LEVELS))}")
        self._say(level, str(text), traceback)

    def debug(self, text: str, *arguments: Any) -> None:
        """Says what only who looks for a fault wants to know.

        Args:
            text: the line.
            arguments: what its `%s` stand for, if it has any.
        """
        self._say("debug", _filled(text, arguments), "")

    def info(self, text: str, *arguments: Any) -> None:
        """Says what happened; the arguments are those of `debug`."""
        self._say("info", _filled(text, arguments), "")

    def warning(self, text: str, *arguments: Any) -> None:
        """Says what may need somebody; the arguments are those of `debug`."""
        self._say("warning", _filled(text, arguments), "")

    def error(self, text: str, *arguments: Any) -> None:
        """Says what has failed; the arguments are those of `debug`."""
        self._say("error", _filled(text, arguments), "")

    def exception(self, text: str, *arguments: Any) -> None:
        """Says what has failed, with the traceback of the exception that is being handled, for the log file."""
        error = sys.exc_info()[1]
        self._say("error", _filled(text, arguments), traceback_of(error) if error is not None else "")

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"the log has no {name!r}{did_you_mean(name, _METHODS, _only(_METHODS))}")


def _filled(text: object, arguments: tuple[Any, ...]) -> str:
    """Returns a line. As with logging, a mistake in it costs the line its form, and not the task its life."""
    line = str(text)
    if not arguments:
        return line
    try:
        return line % arguments
    except (TypeError, ValueError, KeyError):
        return f"{line} {arguments!r}"


def _only(words: tuple[str, ...]) -> str:
    return f", only {', '.join(words)}"


def check_levels(cls: type) -> None:
    """Refuses a class whose methods say lines of a level that there is not: the line might be needed years later.

    Raises:
        ClassError: names the file, the line and the level.
    """
    for part, name, function in given_in(cls):
        if isinstance(function, FunctionType):
            for word, line in _unknown_levels(function.__code__):
                place = f"{function.__code__.co_filename}:{line}"
                hint = did_you_mean(word, _METHODS, _only(LEVELS))
                raise ClassError(f"{place}: {part.__qualname__}.{name}: the log has no level {word!r}{hint}")


def _unknown_levels(code: CodeType) -> Iterator[tuple[str, int]]:
    """Yields what stands for a level in `self.log("...")` and `self.log. ...()`, with its line.

    Of words, only those that others have for a level: the log may be given to another function with any.
    """
    for inner in code.co_consts:
        if isinstance(inner, CodeType) and "self" not in inner.co_varnames[: inner.co_argcount]:
            yield from _unknown_levels(inner)
    if "log" not in code.co_names:
        return
    owner = of_log = False
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("CACHE", "EXTENDED_ARG", "PUSH_NULL"):
            continue
        word = instruction.argval
        is_attribute = instruction.opname in ("LOAD_ATTR", "LOAD_METHOD")
        line = instruction.positions.lineno if instruction.positions is not None else None
        is_word = instruction.opname == "LOAD_CONST" and isinstance(word, str) and word.lower() in _MEANT
        if of_log and ((is_attribute and word not in _METHODS) or (is_word and word not in LEVELS)):
            yield word, line or code.co_firstlineno
        of_log = owner and is_attribute and word == "log"
        # `self` may be loaded together with what comes before it, and is a cell in a method with inner functions.
        last = word[-1] if isinstance(word, tuple) and word else word
        owner = ("LOAD" in instruction.opname and last == "self") or (owner and is_attribute and word == "context")
