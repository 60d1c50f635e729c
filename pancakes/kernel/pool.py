"""Many components on a few threads: the default on a robot.

One worker is at work, one stands by. A worker that readies components does not wake its sibling: threads
that wake each other are what costs under the interpreter lock (measured: reaching 100 subscribers takes a
tenth of the time that a thread for each takes). A watchdog wakes the sibling, or lends one more, where a
handler holds its thread; whoever holds it for long is named.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from pancakes.clock import Clock
from pancakes.kernel.dispatch import Dispatcher
from pancakes.kernel.mailbox import Mailbox

SLICE_S = 0.005
"""A turn ends after this time even if more waits, so that others get theirs."""
WATCH_S = 0.02
"""How often the watchdog looks."""
HOGGED_S = 0.05
"""A handler that holds its thread longer than this is named."""
MOST_WORKERS = 64
STOP_S = 0.3
"""How long, in all, a stop waits for workers that are held."""


class _Worker(threading.Thread):
    """One thread of the pool."""

    def __init__(self, pool: PoolDispatcher, number: int) -> None:
        super().__init__(name=f"{pool.name}-pool-{number}", daemon=True)
        self.pool = pool
        # Held while the worker lies down; a Semaphore would run a page of Python for each wake-up.
        self.wake = threading.Lock()
        self.wake.acquire()
        self.mailbox: Mailbox | None = None
        self.since_s = 0.0
        self.named = False

    def run(self) -> None:
        pool = self.pool
        work = pool.work
        now = pool.clock.now
        while True:
            try:
                mailbox = work.popleft()
            except IndexError:
                if pool.retire(self):
                    return
                continue
            self.since_s = now()
            self.named = False
            self.mailbox = mailbox
            pool.give_turn(mailbox, SLICE_S)
            self.mailbox = None


class PoolDispatcher(Dispatcher):
    """Runs components on a few shared threads.

    Args:
        name: for the names of the threads.
        clock: the host's clock.
        hogged: called by the watchdog, in its thread, with the address of a component that has held a
            worker for `HOGGED_S`, and for how long, in seconds.
    """

    def __init__(self, name: str, clock: Clock, hogged: Callable[[str, float], None] = lambda address, held_s: None):
        self.name = name
        self.clock = clock
        self.work: deque[Mailbox] = deque()
        self._hogged = hogged
        self._lock = threading.Lock()
        self._idle: list[_Worker] = []
        self._workers: list[_Worker] = []
        self._numbers = 0
        self._active = 0
        self._stopping = threading.Event()
        self._watchdog = threading.Thread(target=self._watch, name=f"{name}-pool-watchdog", daemon=True)
        self._watchdog.start()

    def ready(self, mailbox: Mailbox) -> None:
        self.work.append(mailbox)
        # A racy read is enough: a worker looks at `work` once more, under the lock, before it lies down.
        if self._active == 0:
            self._lend()

    def _lend(self) -> None:
        """Puts one more worker to work."""
        with self._lock:
            if self._stopping.is_set() or not self.work or len(self._workers) - len(self._idle) >= MOST_WORKERS:
                return
            self._active += 1
            if self._idle:
                self._idle.pop().wake.release()
                return
            self._numbers += 1
            worker = _Worker(self, self._numbers)
            self._workers.append(worker)
            worker.start()

    def retire(self, worker: _Worker) -> bool:
        """Lays an idle worker down until it is wanted. Returns whether its thread shall end."""
        with self._lock:
            # First the count, then the look: who puts work in reads the count only after that.
            self._active -= 1
            if self.work and not self._stopping.is_set():
                self._active += 1
                return False
            # Two are kept: one for work, one to stand by. Those lent beyond that end here.
            if self._stopping.is_set() or len(self._idle) >= 2:
                self._workers.remove(worker)
                return True
            self._idle.append(worker)
        worker.wake.acquire()
        if self._stopping.is_set():
            with self._lock:
                self._workers.remove(worker)
            return True
        return False

    def _watch(self) -> None:
        while not self._stopping.wait(WATCH_S):
            now_s = self.clock.now()
            held = 0
            for worker in list(self._workers):
                mailbox = worker.mailbox
                held_s = now_s - worker.since_s
                if mailbox is None or held_s < WATCH_S:
                    continue
                held += 1
                component = mailbox.component
                if held_s >= HOGGED_S and not worker.named and component is not None:
                    worker.named = True
                    self._hogged(component.address, held_s)
            if self.work and held >= self._active:
                self._lend()

    def stop(self) -> None:
        self._stopping.set()
        with self._lock:
            for worker in self._idle:
                worker.wake.release()
            self._idle.clear()
            workers = list(self._workers)
        self._watchdog.join()
        until_s = self.clock.now() + STOP_S
        for worker in workers:
            # A worker that is held by a stuck handler is a daemon thread: it must not hold up the rest.
            worker.join(timeout=max(0.0, until_s - self.clock.now()))
