"""Signals that a person sends to end a command, as an event for its threads."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType


def event_at(*signals: signal.Signals, again: int | None = None) -> threading.Event:
    """Returns an event that is set when one of these signals comes. Main thread, and once in a process.

    It is set by a thread that reads what Python writes for each signal at once, and not by a handler. That runs in the
    main thread between any two of its steps, also within the event's own `wait`, which holds the lock that `set` needs.
    And where the signal comes in the moment before the main thread sleeps there, or in another thread, it does not run
    until something else ends the sleep: of 120 views that were ended on a busy machine, 3 went on.

    Args:
        signals: which.
        again: the exit code with which the second one ends the process at once; None: the second one does nothing.
    """
    event = threading.Event()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    seen: list[int] = []

    def pass_on() -> None:
        while not event.is_set():
            if any(number in signals for number in os.read(reader, 64)):
                event.set()

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
