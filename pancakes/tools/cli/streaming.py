"""Print one thing after the other until Ctrl-C, and the signals that end a command."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pancakes.tools.cli.exit_codes import forget_output
from pancakes.tools.cli.options import Duration
from pancakes.tools.cli.output import show_text

if TYPE_CHECKING:
    from pancakes.util.plugins import Plugins


def end_by_signals(*signals: signal.Signals) -> None:
    """From here on these signals end the process at once: nothing is left that must end in order. Main thread."""
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


class Interrupted(threading.Event):
    """Is set once one of some signals has come."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def is_set(self) -> bool:
        # The thread that sets the event runs later than the handler.
        return bool(self.seen) or super().is_set()


def event_at(*signals: signal.Signals, again: int | None = None) -> Interrupted:
    """Return an event that is set when one of these signals comes. Main thread, and once in a process.

    It is set by a thread that reads what Python writes for each signal at once, and not by a handler. That runs in the
    main thread between any two of its steps, also within the event's own `wait`, which has the lock that `set` needs.
    And where the signal comes in the moment before the main thread sleeps there, or in another thread, it does not run
    until something else ends the sleep: of 120 views that were ended on a busy machine, 3 went on.

    Args:
        signals: which.
        again: the exit code with which the second one ends the process at once; None: the second one does nothing.
    """
    event = Interrupted()
    seen = event.seen
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def pass_on() -> None:
        heard = 0
        while not heard or again is not None:
            heard += sum(number in signals for number in os.read(reader, 64))
            if heard:
                event.set()
            if heard > 1 and again is not None:  # the main thread may sleep, and know of neither
                os._exit(again)

    def hear(number: int, frame: FrameType | None) -> None:
        if seen and again is not None:
            os._exit(again)
        seen.append(number)

    threading.Thread(target=pass_on, name="interrupts", daemon=True).start()
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` asks for
            signal.signal(number, hear)
    return event


_F = TypeVar("_F", bound=Callable[..., Any])


@contextmanager
def until_ended() -> Iterator[None]:
    """End its block in good order and without a message at Ctrl-C, or where the reader of the output ends."""
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
    """Say something about the stream on standard error, where it does not mix with it."""
    show_text(text, err=True)


def load_packets(plugins: Plugins | None = None) -> None:
    """Register the packet types of all distributions; name on standard error those that cannot be loaded."""
    from pancakes.util.plugins import Plugins

    for fault in (plugins or Plugins()).load_packets():
        say(str(fault))


def count_option(what: str) -> Callable[[_F], _F]:
    """Return the option `--count`; its parameter is `count`, None if it is not given."""
    return click.option("--count", metavar="N", type=click.IntRange(min=1), help=f"End after N {what}.")


for_option = click.option("--for", "for_s", metavar="TIME", type=Duration(), help="End after this time: 30s.")
"""The option `--for`; its parameter is `for_s`, None if it is not given."""
