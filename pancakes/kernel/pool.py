"""Many components on a few threads: the default on a robot.

One thread is at work, one stands by. A worker that readies components does not wake its sibling: threads
that wake each other are what costs under the interpreter lock (measured: reaching 100 subscribers takes a
tenth of the time that a thread for each takes). For the same reason a thread that is not of the pool and
brings work (the timer's, the network's) may do that work itself, as a guest, while nobody else is at work.
Where a handler holds its thread, a watchdog reckons without that thread until it is back: the sibling, one more
or another guest is at work instead. Whoever holds one for long is named.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from pancakes.clock import Clock
from pancakes.kernel.dispatch import Deferred, Dispatcher, begin_turns
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.shift import SLICE_S, Shift

WATCH_S = 0.02
"""How often the watchdog looks."""
MOST_PASSED_S = 2 * WATCH_S
"""So much counts between two looks, at the most: where the watchdog itself comes late, the machine stood still."""
DOZE_LOOKS = 5
"""After so many looks at which nobody had done anything the watchdog rests until somebody does."""
HOGGED_S = 0.05
"""A handler that holds its thread longer than this is named."""
MOST_WORKERS = 64
"""So many workers may be held at a time, and as many guests."""
STOP_S = 0.3
"""How long, in all, a stop waits for workers that are held."""

_LOG: Final = logging.getLogger("pancakes.kernel")


class _Worker(threading.Thread):
    """One thread of the pool."""

    def __init__(self, pool: PoolDispatcher, number: int) -> None:
        super().__init__(name=f"{pool.name}-pool-{number}", daemon=True)
        self.pool = pool
        self.shift = Shift()
        # Held while the worker lies down; a Semaphore would run a page of Python for each wake-up.
        self.wake = threading.Lock()
        self.wake.acquire()

    def run(self) -> None:
        pool = self.pool
        deferred = begin_turns()
        while True:
            pool.give_turns(self.shift, deferred)
            if pool.retire(self):
                return


class PoolDispatcher(Dispatcher):
    """Runs components on a few shared threads.

    Args:
        name: for the names of the threads.
        clock: the host's clock.
        hogged: called by the watchdog, in its thread, with the address of a component that has held a
            worker for `HOGGED_S`, and for how long at least, in seconds.
    """

    def __init__(self, name: str, clock: Clock, hogged: Callable[[str, float], None] = lambda address, held_s: None):
        self.name = name
        self.clock = clock
        self.work: deque[Mailbox] = deque()
        self._hogged = hogged
        self._lock = threading.Lock()
        self._idle: list[_Worker] = []
        self._workers: list[_Worker] = []
        self._guests: list[Shift] = []
        self._numbers = 0
        self._active = 0
        self._visits = 0
        self._lacks_threads = False
        self._reliefs: list[Callable[[], None]] = []
        self._looked_s = 0.0
        self._stopping = False
        self._dozing = False
        # Held while the watchdog has nothing to be woken for.
        self._alarm = threading.Lock()
        self._alarm.acquire()
        self._watchdog = threading.Thread(target=self._watch, name=f"{name}-pool-watchdog", daemon=True)
        self._watchdog.start()

    def ready(self, mailbox: Mailbox) -> None:
        self.work.append(mailbox)
        # A racy read is enough: a worker looks at `work` once more, under the lock, before it lies down.
        if self._active == 0:
            self._lend()

    def give_turns(self, shift: Shift, deferred: Deferred, until_s: float = math.inf) -> None:
        """Gives turns in this thread to those who have waited longest, until nobody waits or it is late enough.

        Args:
            shift: who gives them.
            deferred: what this thread's turns put off (`begin_turns`).
            until_s: after the first turn that ends at this host time or later it gives no other.
        """
        work, now = self.work, self.clock.now
        limited = until_s < math.inf
        while work:
            try:
                mailbox = work.popleft()
            except IndexError:  # another thread was faster
                return
            shift.turns += 1
            shift.mailbox = mailbox
            component = mailbox.component
            if component is not None:
                component.take_turn(SLICE_S, deferred)
            shift.mailbox = None
            if shift.held:
                self.come_back(shift)
            if limited and now() >= until_s:
                return

    def _lend(self) -> None:
        """Puts a worker to work, if nobody is at it."""
        with self._lock:
            # Where somebody has come to be at work meanwhile, he does it.
            if self._stopping or self._active or len(self._workers) - len(self._idle) >= MOST_WORKERS:
                return
            self._watch_again()
            if self._idle:
                worker = self._idle.pop()
                self._begin(worker.shift)
                worker.wake.release()
                return
            self._numbers += 1
            worker = _Worker(self, self._numbers)
            try:
                worker.start()
            except RuntimeError as error:  # not a fault of whoever has readied a component; the watchdog tries again
                if not self._lacks_threads:
                    _LOG.error("%s has work for another thread, and gets none: %s", self.name, error)
                self._lacks_threads = True
                return
            self._lacks_threads = False
            self._begin(worker.shift)
            self._workers.append(worker)

    def retire(self, worker: _Worker) -> bool:
        """Lays an idle worker down until it is wanted. Returns whether its thread shall end."""
        with self._lock:
            # First the count, then the look: who puts work in reads the count only after that.
            self._end(worker.shift)
            if self.work:
                self._begin(worker.shift)
                return False
            # Two are kept: one for work, one to stand by. Those lent beyond that end here.
            if self._stopping or len(self._idle) >= 2:
                self._workers.remove(worker)
                return True
            self._idle.append(worker)
        worker.wake.acquire()
        if self._stopping:
            with self._lock:
                self._workers.remove(worker)
            return True
        return False

    def welcome(self, guest: Shift) -> bool:
        """Lets a guest do the work, if nobody does it now."""
        if self._active:
            return False
        with self._lock:
            if self._active or self._stopping or len(self._guests) >= MOST_WORKERS:
                return False
            self._begin(guest)
            self._visits += 1
            self._guests.append(guest)
            self._watch_again()
            return True

    def farewell(self, guest: Shift) -> None:
        """Lets a guest go; a worker does what he has left."""
        with self._lock:
            self._guests.remove(guest)
            self._end(guest)
        if self.work:
            self._lend()

    def _begin(self, shift: Shift) -> None:
        """Reckons with somebody from now on. Under the lock."""
        self._active += 1
        shift.here = True
        shift.turns += 1  # what comes before his first turn is not seen as part of the last one

    def _end(self, shift: Shift) -> None:
        """Reckons with somebody no more. Under the lock."""
        shift.here = False
        if shift.held:
            shift.held = False
        else:
            self._active -= 1

    def come_back(self, shift: Shift) -> None:
        """Reckons with somebody again whose turn has ended. In his thread; nobody else takes the mark away."""
        with self._lock:
            shift.held = False
            self._active += 1

    def _watch_again(self) -> None:
        """Wakes the watchdog if it dozes. Under the lock."""
        if self._dozing:
            self._dozing = False
            self._alarm.release()

    def _watch(self) -> None:
        quiet = 0
        before = -1
        while not self._stopping:
            try:
                turns = self._look()
            except Exception:  # without a watchdog one handler could stop everybody
                _LOG.exception("the watchdog of the pool of %s failed", self.name)
                turns = before + 1
            quiet = quiet + 1 if turns == before else 0
            before = turns
            # Fifty wake-ups a second would be the most of what an agent at rest costs.
            self._alarm.acquire(timeout=-1 if quiet >= DOZE_LOOKS and self._may_doze() else WATCH_S)

    def _may_doze(self) -> bool:
        with self._lock:
            at_rest = len(self._idle) == len(self._workers) and not self._guests
            self._dozing = at_rest and not self.work
            return self._dozing

    def _look(self) -> int:
        """Sees whether everybody gets on. Returns a number that changes as long as turns are given."""
        now_s = self.clock.now()
        passed_s = min(now_s - self._looked_s, MOST_PASSED_S)
        self._looked_s = now_s
        with self._lock:
            shifts = [*(worker.shift for worker in self._workers), *self._guests]
            turns = self._visits
        for shift in shifts:
            turns += shift.turns
            mailbox = shift.mailbox
            if not shift.here:
                continue
            seen_s = shift.see(passed_s)
            if seen_s < WATCH_S:
                continue
            self._hold(shift)
            component = mailbox.component if mailbox is not None else None
            if seen_s >= HOGGED_S and not shift.named and component is not None:
                shift.named = True
                self._hogged(component.address, seen_s)
        while self._reliefs:
            self._reliefs[0]()  # where no thread can be started it fails, and is tried again at the next look
            del self._reliefs[0]
        if self.work:
            self._lend()
        return turns

    def _hold(self, shift: Shift) -> None:
        """Reckons without somebody who does not get on; a guest whose turn does not end is to be relieved.

        Whoever is here may be held by what he does before a turn, too, or where the system gives him no core. Whoever
        has got on just now is taken for held until the end of his next turn, which harms nobody.
        """
        with self._lock:
            if not shift.here:
                return
            if not shift.held:
                shift.held = True
                self._active -= 1
            # First the mark, then the look: who comes back looks for the mark when his turn has ended.
            if shift.mailbox is not None and shift.relieve is not None and not shift.relieved:
                shift.relieved = True
                self._reliefs.append(shift.relieve)

    def stop(self) -> None:
        with self._lock:
            self._stopping = True
            for worker in self._idle:
                worker.wake.release()
            self._idle.clear()
            workers = list(self._workers)
            if self._alarm.locked():
                self._alarm.release()
        self._watchdog.join()
        until_s = self.clock.now() + STOP_S
        for worker in workers:
            # A worker that is held by a stuck handler is a daemon thread: it must not hold up the rest.
            worker.join(timeout=max(0.0, until_s - self.clock.now()))
