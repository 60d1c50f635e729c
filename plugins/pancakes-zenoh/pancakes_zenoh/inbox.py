"""What Zenoh's threads hand over to the loop's: in order, bounded, and by a socket, so that the loop's thread may give
turns to the actors that it brings something, as it does for sockets of its own."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Callable
from typing import Final

from pancakes.mesh.event_loop import READ, Loop

MOST_BYTES: Final = 8 * 1024 * 1024
"""How many bytes of frames may wait for the loop; peers that keep to their credit never come near it."""

Call = Callable[[], None]


class Inbox:
    """Calls that wait for the loop's thread.

    Args:
        loop: the transport's thread.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._calls: deque[tuple[int, Call]] = deque()
        self._woken = False
        # Each is written by one side alone.
        self._put_bytes = self._taken_bytes = 0
        self._ear, self._bell = socket.socketpair()
        self._ear.setblocking(False)
        self._bell.setblocking(False)
        loop.call_later(0.0, self._begin)

    def put(self, call: Call) -> None:
        """Runs a call in the loop's thread, behind all that were put before. From any thread."""
        self._add(0, call)

    def put_bytes(self, size: int, call: Call) -> bool:
        """Likewise for bytes that came, in the one thread that brings them; returns whether there was room."""
        if self._put_bytes - self._taken_bytes + size > MOST_BYTES:
            return False
        self._put_bytes += size
        self._add(size, call)
        return True

    def close(self) -> None:
        """Runs no more calls. In the loop's thread."""
        self._loop.forget(self._ear)
        self._ear.close()
        self._bell.close()

    def _add(self, size: int, call: Call) -> None:
        self._calls.append((size, call))
        if not self._woken:
            self._woken = True
            with contextlib.suppress(OSError):  # it is closed
                self._bell.send(b"b")

    def _begin(self) -> None:
        if self._ear.fileno() >= 0:
            self._loop.watch(self._ear, READ, self._ready)

    def _ready(self, _events: int) -> None:
        with contextlib.suppress(BlockingIOError):
            self._ear.recv(64)
        self._woken = False  # before the calls are looked at: one that is put from now on rings again
        for _ in range(len(self._calls)):
            size, call = self._calls.popleft()
            self._taken_bytes += size
            try:
                call()
            except BaseException:
                self._add(0, lambda: None)  # the loop goes on after it, and so do the others
                raise
