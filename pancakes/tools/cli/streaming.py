"""Print a stream until Ctrl-C, and handle the signals that end a command."""

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
    """Let these signals end the process at once from now on. Call it in the main thread."""
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


class Interrupted(threading.Event):
    """An event that is set when one of some signals arrives."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def is_set(self) -> bool:
        # The handler notes the signal before the thread sets the event.
        return bool(self.seen) or super().is_set()


def event_at(*signals: signal.Signals, again: int | None = None) -> Interrupted:
    """Return an event that is set when one of these signals arrives.

    Call it in the main thread, and once in a process. A thread sets the event: it reads the byte that Python writes at
    once for each signal (`signal.set_wakeup_fd`). A Python signal handler could not set it safely, for two reasons. The
    handler runs in the main thread, possibly inside the event's own `wait`, which holds the lock that `set` needs. And
    if the signal arrives just before the main thread sleeps, or in another thread, the handler runs only when something
    else ends the sleep: on a busy machine, 3 of 120 views did not end.

    Args:
        signals: the signals.
        again: the exit code with which a second signal ends the process at once; None: a second signal does nothing.
    """
    event = Interrupted()
    seen = event.seen
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def watch() -> None:
        count = 0
        while not count or again is not None:
            count += sum(number in signals for number in os.read(reader, 64))
            if count:
                event.set()
            if count > 1 and again is not None:  # the main thread may sleep, so its handler may not have run
                os._exit(again)

    def note(number: int, frame: FrameType | None) -> None:
        if seen and again is not None:
            os._exit(again)
        seen.append(number)

    threading.Thread(target=watch, name="interrupts", daemon=True).start()
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` has SIGHUP ignored: leave that
            signal.signal(number, note)
    return event


_F = TypeVar("_F", bound=Callable[..., Any])


@contextmanager
def until_ended() -> Iterator[None]:
    """End the block in order and without a message at Ctrl-C, or when the reader of the output ends."""
    quiet = signal.getsignal(signal.SIGINT) is signal.SIG_DFL  # see `pancakes.tools.cli.quiet_interrupt`
    try:
        if quiet:
            signal.signal(signal.SIGINT, _interrupt)
        yield
    except KeyboardInterrupt:
        if sys.stdout.isatty():
            show_text()  # so that the shell's prompt begins on a new line, after the ^C
    except BrokenPipeError:
        forget_output()
    finally:
        if quiet:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End the block in order at the first SIGINT; let a second one end the process at once."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise KeyboardInterrupt


def say(text: str) -> None:
    """Print a remark about the stream to standard error, so that it does not mix with the stream."""
    show_text(text, err=True)


def load_packets(plugins: Plugins | None = None) -> None:
    """Register the packet types of all distributions; print to standard error those that cannot be loaded."""
    from pancakes.util.plugins import Plugins

    for fault in (plugins or Plugins()).load_packets():
        say(str(fault))


def count_option(what: str) -> Callable[[_F], _F]:
    """Return the option `--count`; its parameter is `count`, None if it is not given."""
    return click.option("--count", metavar="N", type=click.IntRange(min=1), help=f"End after N {what}.")


for_option = click.option("--for", "for_s", metavar="TIME", type=Duration(), help="End after this time: 30s.")
"""The option `--for`; its parameter is `for_s`, None if it is not given."""
