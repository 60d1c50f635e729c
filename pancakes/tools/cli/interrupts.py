"""Signals that a person sends to end a command, as an event for its threads."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType


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
    """Returns an event that is set when one of these signals comes. Main thread, and once in a process.

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
