"""What is said on the channel `log`: events for programs, lines for people, and both as JSON records.

`Log` is the logger of tasks, services and drivers: `self.log.warning("no echo for 2 s")`, as in Python's logging. If
a class uses a level that does not exist, it is refused when it is defined (`check_levels`): the line might be needed
years later.
"""

from __future__ import annotations

import dis
import sys
from collections.abc import Callable, Iterator, Mapping
from types import CodeType, FunctionType
from typing import Any, Final, NoReturn

import msgspec

from pancakes.errors import ClassError, PancakesError, traceback_of
from pancakes.packet import Packet, agent_of, body_to_plain, packet_type
from pancakes.util.arrays import without_arrays
from pancakes.util.class_checks import given_in
from pancakes.util.text import did_you_mean, printable_data

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
        """Log a line whose level is a variable.

        Args:
            level: debug, info, warning or error.
            text: the line.
            traceback: for a failure, what `pancakes.errors.traceback_of` returns; the log file has it.

        Raises:
            PancakesError: there is no such level.
        """
        if level not in LEVELS:
            raise PancakesError(f"the log has no level {level!r}{did_you_mean(level, LEVELS, _only(LEVELS))}")
        self._say(level, str(text), traceback)

    def debug(self, text: str, *arguments: Any) -> None:
        """Log what only a person who looks for a fault needs.

        Args:
            text: the line.
            arguments: what its `%s` stand for, if it has any.
        """
        self._say("debug", _filled(text, arguments), "")

    def info(self, text: str, *arguments: Any) -> None:
        """Log what happened; the arguments are those of `debug`."""
        self._say("info", _filled(text, arguments), "")

    def warning(self, text: str, *arguments: Any) -> None:
        """Log what may need a person; the arguments are those of `debug`."""
        self._say("warning", _filled(text, arguments), "")

    def error(self, text: str, *arguments: Any) -> None:
        """Log what has failed; the arguments are those of `debug`."""
        self._say("error", _filled(text, arguments), "")

    def exception(self, text: str, *arguments: Any) -> None:
        """Log what has failed, with the traceback of the current exception, for the log file."""
        error = sys.exc_info()[1]
        self._say("error", _filled(text, arguments), traceback_of(error) if error is not None else "")

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"the log has no {name!r}{did_you_mean(name, _METHODS, _only(_METHODS))}")


def _filled(text: object, arguments: tuple[Any, ...]) -> str:
    """Return a line. As with logging, a mistake in it costs the line its form, and not the task its life."""
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
    """Refuse a class whose methods log at an unknown level: the line might be needed years later.

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
    """Yield what stands for a level in `self.log("...")` and `self.log. ...()`, with its line.

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


SAID_IN_A_LINE: Final = frozenset(
    (
        *("task_failed", "task_given_up", "task_stuck", "service_failed", "command_refused"),
        *("taken_over", "takeover_waits", "guard_thin", "disk_is_old"),
    )
)
"""Kinds of events that a line tells people about as well: as an event they are shown at level debug."""


@packet_type("event")
class Event(msgspec.Struct, frozen=True):
    """Something that happened, in a form that programs read.

    Attributes:
        kind: what happened, such as `task_started`.
        fields: its particulars, as plain values.
    """

    kind: str
    fields: Mapping[str, Any] = msgspec.field(default_factory=dict)


@packet_type("line")
class LogLine(msgspec.Struct, frozen=True):
    """A line for people.

    Attributes:
        level: one of `LEVELS`.
        text: the line.
        traceback: that of a failure; else empty.
    """

    level: str
    text: str
    traceback: str = ""


def level_of(body: Any) -> str:
    """Return the level of what is said on `log`: an event is `info`, or `debug` if a line says the same."""
    if isinstance(body, LogLine):
        return body.level
    return "debug" if isinstance(body, Event) and body.kind in SAID_IN_A_LINE else "info"


_ENVELOPE: Final = ("t_s", "agent", "source", "kind", "entry", "utc")
"""The fields of a record that events may not set."""


def record_of(packet: Packet) -> dict[str, Any]:
    """Return a packet of `log` as one record of a JSON lines file.

    Source and time are those of the packet, whatever an event claims: a field of the event with such a name gets a `_`
    at its end.
    """
    record: dict[str, Any] = {
        "t_s": round(packet.stamp_s, 6),
        "agent": agent_of(packet.source),
        "source": packet.source,
    }
    body = packet.body
    if isinstance(body, Event):
        record["kind"] = body.kind
        fields = without_arrays(body.fields)
        return record | {f"{key}_" if key in _ENVELOPE else key: value for key, value in fields.items()}
    if isinstance(body, LogLine):
        record = {**record, "kind": "line", "level": body.level, "text": body.text}
        return {**record, "traceback": body.traceback} if body.traceback else record
    return {**record, "kind": packet.type, "body": body_to_plain(body)}


def line_of(record: dict[str, Any]) -> str:
    """Return a record as one line of JSON, its keys in their order."""
    import json  # takes 2 ms of an agent's start, for files and questions that most agents never see

    return printable_data(json.dumps(record, ensure_ascii=False, default=str, separators=(", ", ": ")))
