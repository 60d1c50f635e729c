"""Signals that a person sends to end a command, as an event for its threads."""

from __future__ import annotations

import os
import signal
import threading
from queue import SimpleQueue
from types import FrameType


def event_at(*signals: signal.Signals, again: int | None = None) -> threading.Event:
    """Returns an event that is set when one of these signals comes. Main thread.

    A handler may not set an event itself: it runs in the main thread between any two of its steps, also within the
    event's own `wait`, which holds the lock that `set` needs. A `SimpleQueue` may be put to from anywhere.

    Args:
        signals: which.
        again: the exit code with which the second one ends the process at once; None: the second one does nothing.
    """
    event = threading.Event()
    heard: SimpleQueue[int] = SimpleQueue()
    seen: list[int] = []

    def pass_on() -> None:
        heard.get()
        event.set()

    def hear(number: int, frame: FrameType | None) -> None:
        if seen and again is not None:
            os._exit(again)
        seen.append(number)
        heard.put(number)

    threading.Thread(target=pass_on, name="interrupts", daemon=True).start()
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` asks for
            signal.signal(number, hear)
    return event
