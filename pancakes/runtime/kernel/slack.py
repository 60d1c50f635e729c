"""Lets a thread that waits for a point in time wake on time."""

from __future__ import annotations

import threading


def wake_on_time() -> None:
    """Asks the system to put off no wake-up of the calling thread.

    Linux may let each timed wait take 50 µs longer, to save power. Measured with one task at 1 kHz: without it, the
    median lateness of a bare thread is 75 µs, with it 25 µs. Where there is no such thing, nothing happens.
    """
    try:
        # A thread may write its own; any value below the smallest step of the clock means "none".
        with open(f"/proc/{threading.get_native_id()}/timerslack_ns", "w") as slack:
            slack.write("1")
    except OSError:
        pass
