"""The network thread: wait for sockets and timers, and run their callbacks.

The thread may also run turns of the actors that it has brought packets to, as a guest of the kernel's pool. A packet
then reaches its task, and the task's answer the socket, without a change of thread: one wake-up a packet on each side
of a round trip, instead of two. If a turn blocks the thread, another thread takes the loop over.

To sleep and be woken costs more than a packet. So after several packets in quick succession the thread polls for a
moment instead of sleeping (busy polling). Packets at longer intervals find it asleep, which saves the battery.
"""

from __future__ import annotations

import heapq
import logging
import os
import selectors
import socket
import threading
from collections.abc import Callable
from typing import Final

from pancakes.kernel.dispatchers import GUEST_S, Guest
from pancakes.kernel.mailbox import LONGEST_S
from pancakes.util.clock import Clock

BUSY_POLL_S: Final = 0.0005
"""How long the thread stays awake for the next packet, unless the configuration sets another time.

It must be longer than a round trip over TLS on a slow board.
"""
STREAK: Final = 8
"""How many waits in a row must end that soon before the thread stays awake. Two packets that come together, such as
those of two agents that tick at the same time, are not a dialogue.
"""

give_way: Final[Callable[[], object] | None] = getattr(os, "sched_yield", None)

Ready = list[tuple[int, int]]
"""File descriptors of sockets, each with the events that it is ready for."""


class BusyPoll:
    """Wait until sockets are ready.

    It yields to any other process that wants the core, so agents that share cores cost each other nothing. If the
    system has no way to yield, it always sleeps.

    Args:
        poll: waits for sockets, for a number of seconds or, with None, for ever.
        now: the host clock.
        busy_poll_s: how long it stays awake; 0: it always sleeps. May be changed later.
    """

    def __init__(self, poll: Callable[[float | None], Ready], now: Callable[[], float], busy_poll_s: float) -> None:
        self._poll = poll
        self._now = now
        self.busy_poll_s = busy_poll_s
        self._streak = 0

    def wait(self, until_s: float | None) -> Ready:
        """Return the sockets that are ready, none if none is ready by `until_s` (host time; None: no limit)."""
        now, poll, busy_poll_s = self._now, self._poll, self.busy_poll_s
        began_s = now_s = now()
        if self._streak >= STREAK and give_way is not None:
            end_s = began_s + busy_poll_s
            if until_s is not None and until_s < end_s:
                end_s = until_s
            while now_s < end_s:
                ready = poll(0)
                if ready:
                    return ready
                give_way()
                now_s = now()
        ready = poll(None if until_s is None else max(0.0, min(until_s - now_s, LONGEST_S)))
        self._streak = self._streak + 1 if ready and now() - began_s < busy_poll_s else 0
        return ready


READ: Final = selectors.EVENT_READ
WRITE: Final = selectors.EVENT_WRITE

READING_S: Final = 0.0002
"""After this much reading, the actors that got packets have their turns before more is read: the decoded packets are
then still in the processor's cache, and little waits in mailboxes. Measured with eight agents that send to one as
fast as they can: 2.1 µs of its processor time for each packet, instead of 2.9 if all are read first.
"""

_LOG = logging.getLogger("pancakes.mesh")


class TimerHandle:
    """A call that was scheduled for later."""

    __slots__ = ("function",)

    def __init__(self, function: Callable[[], None] | None) -> None:
        self.function = function

    def cancel(self) -> None:
        """Prevent the call, if it has not begun. From any thread."""
        self.function = None


class Loop:
    """A selector and its thread.

    Args:
        clock: the host clock.
        name: name of the thread.

    Attributes:
        busy_poll: how it waits.
        stopping: whether it has been told to stop.
    """

    def __init__(self, clock: Clock, name: str) -> None:
        self.now = self._now = clock.now
        self._selector = selectors.DefaultSelector()
        self.busy_poll = BusyPoll(self._poll, clock.now, 0.0)
        self._watched: dict[int, Callable[[int], None]] = {}  # by file descriptor
        self._forgotten: dict[int, None] = {}  # those forgotten since the last poll
        self._lock = threading.Lock()
        self._timers: list[tuple[float, int, TimerHandle]] = []
        self._count = 0
        self.stopping = False
        self._ended = False
        self._over = threading.Event()
        self._woken = False
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._wake_writer.setblocking(False)
        self.watch(self._wake_reader, READ, self._take_wake)
        self._name = name
        self._make_guest: Callable[[Callable[[], None]], Guest] | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def lend(self, make_guest: Callable[[Callable[[], None]], Guest], busy_poll_s: float = 0.0) -> None:
        """Let the loop's thread run turns as a guest from now on; see `Transport.lend_thread`."""
        self._make_guest = make_guest
        self.busy_poll.busy_poll_s = busy_poll_s

    def call_later(self, delay_s: float, function: Callable[[], None]) -> TimerHandle:
        """Run `function` in the loop's thread in `delay_s` seconds; 0: as soon as it is idle. From any thread.

        After `stop` nothing is run.
        """
        with self._lock:
            if self.stopping:
                return TimerHandle(None)
            timer = self._put(self._now() + delay_s, function)
            if self._timers[0][2] is timer:
                self._wake()
        return timer

    def _put(self, due_s: float, function: Callable[[], None]) -> TimerHandle:
        """Add a function to the timers. Under the lock."""
        timer = TimerHandle(function)
        self._count += 1  # of two that are due at the same time, the first added runs first
        heapq.heappush(self._timers, (due_s, self._count, timer))
        return timer

    def watch(self, sock: socket.socket, events: int, function: Callable[[int], None]) -> None:
        """Call `function` with the events (READ, WRITE) that `sock` is ready for. In the loop's thread.

        A socket whose connection has failed or ended is ready for both.
        """
        number = sock.fileno()
        if number in self._watched:
            self._selector.modify(number, events)
        else:
            self._selector.register(number, events)
        self._watched[number] = function

    def _poll(self, timeout_s: float | None) -> list[tuple[int, int]]:
        return [(key.fd, events) for key, events in self._selector.select(timeout_s)]

    def forget(self, sock: socket.socket) -> None:
        """Stop watching `sock`. Call it before closing the socket, in the loop's thread."""
        number = sock.fileno()
        if self._watched.pop(number, None) is not None:
            self._selector.unregister(number)
            self._forgotten[number] = None

    def is_here(self) -> bool:
        """Return whether the caller runs in the loop's thread."""
        return threading.current_thread() is self._thread

    def stop(self, last: Callable[[], None]) -> None:
        """Run what is due, then `last`, and end the thread. Wait for that, unless called in the thread itself."""
        with self._lock:
            if not self.stopping:
                self.stopping = True
                self._put(self._now(), lambda: self._end(last))
                self._wake()
        if not self.is_here():
            # The thread itself is not waited for yet: a turn may hold it, and then another thread ends in its place.
            self._over.wait()
            self._thread.join()

    def _end(self, last: Callable[[], None]) -> None:
        self._ended = True
        last()

    def _wake(self) -> None:
        if not self._woken and not self.is_here():
            self._woken = True
            self._wake_writer.send(b"w")

    def _take_wake(self, _events: int) -> None:
        with self._lock:
            self._woken = False
            self._wake_reader.recv(64)

    def _run(self) -> None:
        goes_on = False
        try:
            goes_on = self._serve()
        finally:
            if not goes_on and self.is_here():
                self._selector.close()
                self._wake_reader.close()
                self._wake_writer.close()
                self._over.set()

    def _serve(self) -> bool:
        """Do all work that is due, until the end or until another thread takes over; return whether one does."""
        guest: Guest | None = None
        timers, now, wait = self._timers, self._now, self.busy_poll.wait
        while not self._ended:
            self._forgotten.clear()
            # Without the lock: only this thread removes timers, and a thread that adds an earlier one wakes it.
            ready = wait(timers[0][0] if timers else None)
            if guest is None and self._make_guest is not None:
                guest = self._make_guest(self._take_over)
            # All sockets come before any timer, so that after a pause of this process (a debugger, SIGSTOP) what
            # peers sent in the meantime is read before their silence is judged.
            self._serve_sockets(ready, guest if ready and guest is not None and guest.arrive() else None)
            if guest is not None and not guest.stays:
                return True
            if timers and timers[0][0] <= now():
                self._run_timers()
        return False

    def _serve_sockets(self, ready: list[tuple[int, int]], guest: Guest | None) -> None:
        """Serve sockets that are ready; as a guest, run the turns of the actors that got packets."""
        now, watched, forgotten = self._now, self._watched, self._forgotten
        last_s = now()
        left = len(ready)
        try:
            for number, events in ready:
                left -= 1
                if number not in forgotten:  # by an earlier handler; another socket may have its descriptor by now
                    try:
                        watched[number](events)
                    except Exception:  # as in `_guard`
                        _LOG.exception("a handler of the network failed")
                if guest is None:
                    continue
                now_s = now()
                if now_s - last_s < READING_S and left:
                    continue
                guest.work(now_s + GUEST_S)
                if not guest.stays:
                    return  # the thread that took over finds the others ready too
                last_s = now()
        finally:
            if guest is not None:
                self._guard(guest.leave)

    def _take_over(self) -> None:
        """Start another thread for the loop, because a turn holds this one. From any thread."""
        with self._lock:  # a timer that is added meanwhile is seen by the new thread, or wakes it
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def _run_timers(self) -> None:
        now_s = self._now()
        while self._timers and self._timers[0][0] <= now_s and not self._ended:
            with self._lock:
                timer = heapq.heappop(self._timers)[2]
            if timer.function is not None:
                self._guard(timer.function)

    def _guard(self, function: Callable[[], None]) -> None:
        try:
            function()
        except Exception:  # a fault in one handler must not stop all the others
            _LOG.exception("a handler of the network failed")
