"""Whether something has happened, once."""

from __future__ import annotations

import contextlib
import threading


class Flag:
    """What pykka uses of a `threading.Event`, with one lock and nothing else: there is one for each actor."""

    __slots__ = ("_gate", "_on")

    def __init__(self) -> None:
        self._on = False
        self._gate = threading.Lock()  # held until it happens
        self._gate.acquire()

    def is_set(self) -> bool:
        """Returns whether it has happened."""
        return self._on

    def set(self) -> None:
        """Says that it has happened."""
        self._on = True
        with contextlib.suppress(RuntimeError):  # it had happened already
            self._gate.release()

    def wait(self, timeout: float | None = None) -> bool:
        """Waits until it happens, for so many seconds at the most; returns whether it has."""
        if not self._on and self._gate.acquire(timeout=-1 if timeout is None else timeout):
            with contextlib.suppress(RuntimeError):
                self._gate.release()  # for the next thread that waits
        return self._on
