"""Exit codes, and the one place that turns an error into a sentence for people and an exit code for scripts.

A `Guarded` click command ends with such a sentence instead of a traceback, even if the reader of its output ends early
(`| head`).
"""

from __future__ import annotations

import errno
import inspect
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, NoReturn

import click

from pancakes.errors import EXTRAS, ConfigError, PancakesError, UnreachableError, missing_extra
from pancakes.util.docstring import docstring_of

OK: Final = 0
REFUSED: Final = 1
"""The command was understood but not carried out: an agent refused it, a port is in use, ..."""
USAGE: Final = 2
"""The command line itself is wrong; click reports it."""
UNREACHABLE: Final = 3
"""No agent answered."""
BAD_CONFIGURATION: Final = 4
INTERRUPTED: Final = 130
"""A command with an end of its own was ended by Ctrl-C before that."""
UNREAD: Final = 141
"""The reader of the output ended early. Shells give the same exit code to tools that SIGPIPE ends."""

TRACEBACK: Final = "PANCAKES_TRACEBACK"
"""The environment variable that makes a defect show its traceback, for the developer who fixes it."""

UNWRITABLE: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""Errors of the place that output goes to, such as a full disk."""


def exit_code(error: PancakesError) -> int:
    """Return the exit code for an error."""
    if isinstance(error, ConfigError):
        return BAD_CONFIGURATION
    if isinstance(error, UnreachableError):
        return UNREACHABLE
    return REFUSED


def fail(error: Exception) -> NoReturn:
    """Print what is wrong to standard error, and exit."""
    from pancakes.tools.cli.output import show_text  # late import: help needs no msgspec

    if isinstance(error, PancakesError):
        show_text(str(error), err=True)
        sys.exit(exit_code(error))
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        show_text(f"cannot write {error.filename or 'the output'}: {error.strerror}", err=True)
        if not error.filename:
            forget_output()
        sys.exit(REFUSED)
    missing = missing_extra(error)
    if missing:
        show_text(f"this needs {missing}: pip install 'pancakes-agents[{EXTRAS[missing]}]'", err=True)
        sys.exit(REFUSED)
    if os.environ.get(TRACEBACK):
        raise error
    text = " ".join(str(error).split())
    show_text(
        f"a defect in Pancakes or in a plug-in: {type(error).__name__}: {text} (set {TRACEBACK}=1 to see where)",
        err=True,
    )
    sys.exit(REFUSED)


def end_unread() -> NoReturn:
    """Exit without a message: the reader of the output, such as `head`, has ended."""
    forget_output()
    sys.exit(UNREAD)


def forget_output() -> None:
    """Discard the output that Python still buffers: flushing it at exit would report an error."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    if sys.stdout is not None and not sys.stdout.closed and (used := _file_of(sys.stdout)) not in (None, 1):
        os.dup2(nothing, used)


def _file_of(stream: Any) -> int | None:
    try:
        return int(stream.fileno())
    except (OSError, ValueError):
        return None


@contextmanager
def sentences() -> Iterator[None]:
    """Turn errors that leave the block into sentences, so that users see no traceback."""
    try:
        yield
    except (click.ClickException, click.exceptions.Exit, click.Abort):
        raise  # click prints its own sentences for these
    except BrokenPipeError:
        end_unread()
    except Exception as error:
        fail(error)


def with_help(command: click.Command) -> click.Command:
    """Give a command, and those of a group, the help that click takes from docstrings: `python -OO` has none."""
    if sys.flags.optimize >= 2:
        if not command.help and command.callback is not None:
            command.help = docstring_of(inspect.unwrap(command.callback)) or None
        for inner in command.commands.values() if isinstance(command, click.Group) else ():
            with_help(inner)
    return command


class Guarded(click.Command):
    """A click command whose errors become sentences, even if the reader of its output ends early (`| head -1`).

    A group of this class also does this for its commands.
    """

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        with_help(self)
        with sentences():
            return super().make_context(*args, **more)

    def invoke(self, ctx: click.Context) -> Any:
        with sentences():
            return super().invoke(ctx)
