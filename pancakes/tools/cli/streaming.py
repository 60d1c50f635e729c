"""What verbs share that print one thing after the other, perhaps until Ctrl-C."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pancakes.packet import body_to_plain
from pancakes.runtime.foundation.codecs import encode_json
from pancakes.runtime.foundation.printable import printable_data
from pancakes.tools.cli.exit_codes import forget_output
from pancakes.tools.cli.options import Duration
from pancakes.tools.cli.output import show_text

if TYPE_CHECKING:
    from pancakes.runtime.plugins import Plugins

_F = TypeVar("_F", bound=Callable[..., Any])


def one_line(value: Any) -> str:
    """Returns a value as JSON in one line; numbers that JSON does not know (NaN, infinity) become null."""
    return printable_data(encode_json(body_to_plain(value)).decode())


class Printer:
    """Prints values to standard output as they come: as text for people, or as JSON for programs.

    As JSON they become a list where they are `bounded`, that is, where the command ends by itself, and one object a
    line where it does not. It is a context manager, which ends that list.

    Args:
        format_: `table` or `json`.
        bounded: whether the command ends by itself.
        text: makes the text of a value.
        colour: returns the colour of a value's text, where it has one.
    """

    def __init__(
        self,
        format_: str,
        bounded: bool,
        text: Callable[[Any], str],
        colour: Callable[[Any], str | None] = lambda value: None,
    ) -> None:
        self._json = format_ == "json"
        self._list = self._json and bounded
        self._text = text
        self._colour = colour
        self.printed = 0

    def __enter__(self) -> Printer:
        return self

    def show(self, value: Any) -> None:
        """Prints a value."""
        if self._list:
            show_text(("[\n  " if self.printed == 0 else ",\n  ") + one_line(value), nl=False)
        elif self._json:
            show_text(one_line(value))
        else:
            show_text(self._text(value), colour=self._colour(value))
        self.printed += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # A user who ends the command early still gets a list. Where it failed, there may be nothing to end.
        if self._list and (kind is None or issubclass(kind, KeyboardInterrupt) or self.printed):
            if not isinstance(error, BrokenPipeError):
                show_text("\n]" if self.printed else "[]")


@contextmanager
def until_ended() -> Iterator[None]:
    """Ends its block in good order and without a message at Ctrl-C, or where the reader of the output ends."""
    quiet = signal.getsignal(signal.SIGINT) is signal.SIG_DFL  # see `pancakes.tools.cli.quiet_interrupt`
    try:
        if quiet:
            signal.signal(signal.SIGINT, _interrupt)
        yield
    except KeyboardInterrupt:
        if sys.stdout.isatty():
            show_text()  # so that the shell's prompt does not stand behind the ^C
    except BrokenPipeError:
        forget_output()
    finally:
        if quiet:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """The first SIGINT ends what goes on in good order, the second one ends the process at once."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise KeyboardInterrupt


def say(text: str) -> None:
    """Says something about the stream on standard error, where it does not mix with it."""
    show_text(text, err=True)


def load_packets(plugins: Plugins | None = None) -> None:
    """Registers the packet types of all distributions; names on standard error those that cannot be loaded."""
    from pancakes.runtime.plugins import Plugins

    for fault in (plugins or Plugins()).load_packets():
        say(str(fault))


def count_option(what: str) -> Callable[[_F], _F]:
    """Returns the option `--count`; its parameter is `count`, None where it is not given."""
    return click.option("--count", metavar="N", type=click.IntRange(min=1), help=f"End after N {what}.")


for_option = click.option("--for", "for_s", metavar="TIME", type=Duration(), help="End after this time: 30s.")
"""The option `--for`; its parameter is `for_s`, None where it is not given."""
