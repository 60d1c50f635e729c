"""The options of `pancakes-agent`, and those command lines that can be read without click.

click has the last word on every command line, and the words for what is wrong with one. But an agent that is started
needs nothing else of it, and to import it and to let it read two options takes 33 million instructions of the 460
million until the agent's first tick. So command lines of the usual form are read here, and click is imported for all
others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

SHOW_TRACEBACKS: Final = "service.log.settings.traceback=true"
"""What `--traceback` changes of a configuration."""
LOWEST_READY_FD: Final = 3
"""Those below are the standard streams."""


class Options(NamedTuple):
    """What a command line asks for.

    Attributes:
        path: the configuration file.
        sets: what is changed of it, each as `table.key=value`.
        record: the file to record into, empty for where the configuration says; None: nothing is recorded.
        check: whether the configuration is only checked.
        parent_pid: the process with which the agent ends, 0 for whichever launched it; None: it ends with none.
        ready_fd: the file descriptor that learns when the agent is ready; None: none.
        traceback: whether failures are shown with their tracebacks.
    """

    path: str
    sets: tuple[str, ...] = ()
    record: str | None = None
    check: bool = False
    parent_pid: int | None = None
    ready_fd: int | None = None
    traceback: bool = False


def usual(arguments: Sequence[str]) -> Options | None:
    """Reads a command line of the form in which people and launchers start agents.

    That is any number of `--config FILE`, `--set KEY=VALUE`, `--die-with-parent PID` and `--ready-fd FD`, with a space
    or `=` before the value, and nothing else.

    Returns:
        What click would make of it; None where only click knows.
    """
    texts: dict[str, list[str]] = {"--config": [], "--set": [], "--die-with-parent": [], "--ready-fd": []}
    words = iter(arguments)
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            value = next(words, "")
        if name not in texts or not value or (value.startswith("-") and not equals):
            return None
        texts[name].append(value)
    try:
        parent_pid, ready_fd = _last_number(texts["--die-with-parent"]), _last_number(texts["--ready-fd"])
    except ValueError:
        return None
    if not texts["--config"] or (ready_fd is not None and ready_fd < LOWEST_READY_FD):
        return None
    return Options(texts["--config"][-1], tuple(texts["--set"]), parent_pid=parent_pid, ready_fd=ready_fd)


_MOST_DIGITS: Final = 18
"""A number of more digits is left to click, which has words also for those that Python does not read."""


def _last_number(texts: Sequence[str]) -> int | None:
    """Returns the last of some numbers; None where there are none.

    Raises:
        ValueError: one of them is no number, or none that is read here.
    """
    for text in texts:
        if not (text.isascii() and text.isdecimal() and len(text) <= _MOST_DIGITS):
            raise ValueError(f"{text!r} is no number of {_MOST_DIGITS} digits at most")
    return int(texts[-1]) if texts else None
