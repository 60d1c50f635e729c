"""Dispatchers decide in which thread a component runs; the component never knows (Akka's word).

`PoolDispatcher` runs many components on a few threads, the default on a robot. One thread works, one stands by. A
worker that readies components does not wake another one: threads that wake each other are what costs under the
interpreter lock. For the same reason a thread that brings work (the timer's, the network's) does that work itself, as
a `Guest`, while no other thread works. If a handler holds its thread, a watchdog stops counting on that thread, and
another one takes over; the watchdog logs components that hold a thread for long.

`PinnedDispatcher` gives a component that must wait a thread of its own, in which the event loop of one that awaits runs
between its turns. `pancakes.kernel.virtual_time` has the
dispatcher that runs whole fleets on one thread.
"""

from __future__ import annotations

import logging
import math
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final

from pancakes.kernel.mailbox import Mailbox, Runnable
from pancakes.packet import THREAD
from pancakes.util.clock import Clock


def defer(function: Callable[[], None]) -> None:
    """Run `function` at the end of the turn that this thread gives now, or at once outside of a turn."""
    turn = THREAD.turn
    if turn.reader is None:
        function()
    else:
        turn.deferred.append(function)


def is_for_program(error: BaseException) -> bool:
    """Tell whether an exception is for the program that runs an actor, and no failure of that actor.

    A signal's handler raises such exceptions in the midst of whatever the main thread does: KeyboardInterrupt, the
    time-out of a test. So do test frameworks to end a test: what `pytest.fail` and `pytest.skip` raise. Python's rule
    is that no ordinary error derives from BaseException directly.
    """
    return not isinstance(error, (Exception, SystemExit, GeneratorExit))


class Dispatcher(ABC):
    """Gives turns to components whose mailboxes have something in them."""

    @abstractmethod
    def ready(self, mailbox: Mailbox) -> None:
        """See that the component of `mailbox`, whose token is held, gets a turn. Any thread."""

    def attach(self, component: Runnable) -> None:
        """Let `component` run from now on; its first turn calls `on_start`. Any thread."""
        mailbox = component.actor_inbox
        mailbox.dispatch = self
        mailbox.component = component
        self.ready(mailbox)

    def stop(self) -> None:
        """End the dispatcher's threads. Not to be called from one of them."""

    def give_turn(self, mailbox: Mailbox, slice_s: float | None = None) -> None:
        """Give the component of `mailbox` one turn in this thread, if it has one.

        Args:
            mailbox: its mailbox, whose token is held.
            slice_s: after this time the turn ends even if more waits; None: no limit.
        """
        component = mailbox.component
        if component is not None:
            component.take_turn(slice_s)


class Shift:
    """A thread that gives the pool's turns: one of its workers, or a guest.

    Args:
        relieve: for a guest: lets another thread do the guest's own duties.

    Attributes:
        mailbox: whose turn it gives now.
        turns: how many it has given.
        relieved: whether another thread does its duties.
        here: whether it is at work, or called to it; under the pool's lock.
        held: whether the pool does not count on it though it is here, because a turn does not end.
        named: whether the watchdog has named the component that holds it.
    """

    def __init__(self, relieve: Callable[[], None] | None = None) -> None:
        self.relieve = relieve
        self.mailbox: Mailbox | None = None
        self.turns = 0
        self.relieved = False
        self.here = False
        self.held = False
        self.named = False
        self._seen = -1
        self._seen_s = 0.0

    def see(self, passed_s: float) -> float:
        """Return for how long the watchdog has seen it at one and the same turn; `passed_s` since the last look."""
        if self.turns != self._seen:
            self._seen = self.turns
            self._seen_s = 0.0
            self.named = False
        else:
            self._seen_s += passed_s
        return self._seen_s


SLICE_S: Final = 0.002
"""A turn ends after this time even if more waits, so that others get theirs."""
WATCH_S: Final = 0.02
"""How often the watchdog looks."""
MOST_PASSED_S: Final = 2 * WATCH_S
"""The most that counts between two looks: if the watchdog itself comes late, the machine stood still."""
DOZE_LOOKS: Final = 1
"""The watchdog rests after this many looks at which no turn was given, until a thread is at work."""
HOGGED_S: Final = 0.05
"""A handler that holds its thread longer than this is named."""
MOST_WORKERS: Final = 64
"""The most workers that may be held at a time, and the most guests."""
MOST_IDLE: Final = 2
"""The most idle workers that are kept: one for work, one to stand by."""
STOP_S: Final = 0.3
"""How long, in all, a stop waits for workers that are held."""

_LOG: Final = logging.getLogger("pancakes.kernel")


class _Worker(threading.Thread):
    """One thread of the pool.

    Attributes:
        wake: released when an idle worker is wanted.
    """

    def __init__(self, pool: PoolDispatcher, number: int) -> None:
        super().__init__(name=f"{pool.name}-pool-{number}", daemon=True)
        self.pool = pool
        self.shift = Shift()
        self.wake = threading.Lock()
        self.wake.acquire()

    def run(self) -> None:
        while True:
            self.pool.give_turns(self.shift)
            if self.pool.retire(self):
                return


class PoolDispatcher(Dispatcher):
    """Runs components on a few shared threads.

    Args:
        name: for the names of the threads.
        clock: the host's clock.
        hogged: called by the watchdog, in its thread, with a component that has held a worker for `HOGGED_S`, and for
            how long at least, in seconds.

    Attributes:
        work: the mailboxes whose components are to get a turn.
    """

    def __init__(self, name: str, clock: Clock, hogged: Callable[[Runnable, float], None] = lambda held, held_s: None):
        self.name = name
        self.clock = clock
        self.work: deque[Mailbox] = deque()
        self._hogged = hogged
        self._lock = threading.Lock()
        self._idle: list[_Worker] = []
        self._workers: list[_Worker] = []
        self._guests: list[Shift] = []
        self._numbers = 0
        self._active = 0  # threads at work that are not held
        self._visits = 0
        self._lacks_threads = False
        self._reliefs: list[Callable[[], None]] = []
        self._looked_s = 0.0
        self._stopping = False
        self._dozing = False
        self._alarm = threading.Lock()  # released to wake the watchdog
        self._alarm.acquire()
        self._watchdog = threading.Thread(target=self._watch, name=f"{name}-pool-watchdog", daemon=True)
        self._watchdog.start()

    def ready(self, mailbox: Mailbox) -> None:
        self.work.append(mailbox)
        # A racy read is enough: a worker looks at `work` once more, under the lock, before it lies down.
        if self._active == 0:
            self._lend()

    def give_turns(self, shift: Shift, until_s: float = math.inf) -> bool:
        """Give turns in this thread, the longest waiting first, until no more wait or it is late enough.

        Args:
            shift: the calling thread's.
            until_s: after the first turn that ends at this host time or later it gives no other.

        Returns:
            False if it was that late.
        """
        while self.work:
            try:
                mailbox = self.work.popleft()
            except IndexError:  # another thread was faster
                break
            shift.turns += 1
            shift.mailbox = mailbox
            self.give_turn(mailbox, SLICE_S)
            shift.mailbox = None
            if shift.held:
                self._come_back(shift)
            if shift.relieved:
                break
            if until_s < math.inf and self.clock.now() >= until_s:
                return False
        return True

    def _lend(self) -> None:
        """Put a worker to work, if no thread is at work."""
        lack: RuntimeError | None = None
        with self._lock:
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
            except RuntimeError as error:  # no fault of the publisher that called this; the watchdog tries again
                lack = None if self._lacks_threads else error
                self._lacks_threads = True
            else:
                self._lacks_threads = False
                self._begin(worker.shift)
                self._workers.append(worker)
        if lack is not None:
            # Without the lock: an agent publishes its log, which leads here again.
            _LOG.error("%s has work for another thread, and gets none: %s", self.name, lack)

    def retire(self, worker: _Worker) -> bool:
        """Put an idle worker to sleep until it is wanted; return whether its thread must end."""
        with self._lock:
            # First the count, then the look: a thread that puts work in reads the count only after that.
            self._end(worker.shift)
            if self.work:
                self._begin(worker.shift)
                return False
            if self._stopping or len(self._idle) >= MOST_IDLE:
                self._workers.remove(worker)
                return True
            self._idle.append(worker)
        worker.wake.acquire()
        if self._stopping:
            with self._lock:
                self._workers.remove(worker)
            return True
        return False

    def begin_guest(self, guest: Shift) -> bool:
        """Let a guest do the work, if no other thread does it now."""
        with self._lock:
            if self._active or self._stopping or len(self._guests) >= MOST_WORKERS:
                return False
            self._begin(guest)
            self._visits += 1
            self._guests.append(guest)
            self._watch_again()
            return True

    def end_guest(self, guest: Shift) -> None:
        """Let a guest go; a worker does what it has left."""
        with self._lock:
            self._guests.remove(guest)
            self._end(guest)
        if self.work:
            self._lend()

    def _begin(self, shift: Shift) -> None:
        """Count on a thread from now on. Under the lock."""
        self._active += 1
        shift.here = True
        shift.turns += 1  # its work before the first turn is not seen as part of the last one

    def _end(self, shift: Shift) -> None:
        """Count on a thread no more. Under the lock."""
        shift.here = False
        if shift.held:
            shift.held = False
        else:
            self._active -= 1

    def _come_back(self, shift: Shift) -> None:
        """Count on a thread again whose turn has ended. In that thread; no other one takes the mark away."""
        with self._lock:
            shift.held = False
            self._active += 1

    def _watch_again(self) -> None:
        """Wake the watchdog if it dozes. Under the lock."""
        if self._dozing:
            self._dozing = False
            self._alarm.release()

    def _watch(self) -> None:
        quiet = 0
        before = -1
        while not self._stopping:
            try:
                turns = self.look()
            except Exception:  # without a watchdog one handler could stop all others
                _LOG.exception("the watchdog of the pool of %s failed", self.name)
                turns = before + 1
            quiet = quiet + 1 if turns == before else 0
            before = turns
            # Regular wake-ups would be the most of what an agent at rest costs.
            self._alarm.acquire(timeout=-1 if quiet >= DOZE_LOOKS and self._may_doze() else WATCH_S)

    @property
    def at_rest(self) -> bool:
        """Whether no thread is at work, and none is held."""
        return len(self._idle) == len(self._workers) and not self._guests

    def _may_doze(self) -> bool:
        with self._lock:
            self._dozing = self.at_rest and not self.work
            return self._dozing

    def look(self) -> int:
        """Do what the watchdog does at each look; return a number that changes as long as turns are given."""
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
                self._hogged(component, seen_s)
        while self._reliefs:
            self._reliefs[0]()  # if no thread can be started it fails, and is tried again at the next look
            del self._reliefs[0]
        if self.work:
            self._lend()
        return turns

    def _hold(self, shift: Shift) -> None:
        """Stop counting on a thread whose turn does not end; another thread takes over a guest's duties.

        A thread may be held by what it does before a turn, too, or because the system gives it no core. One whose turn
        has ended just now is taken for held until the end of its next turn, which does no harm.
        """
        with self._lock:
            if not shift.here:
                return
            if not shift.held:
                shift.held = True
                self._active -= 1
            # First the mark, then the look: a thread looks for the mark when its turn has ended.
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


GUEST_S: Final = 0.002
"""A guest, which has duties of its own, should not work longer."""


class Guest:
    """A thread that is not the pool's, but gives its turns while no other thread does.

    Its loop:

        while guest.stays:
            ...                          # wait
            here = guest.arrive()
            ...                          # what readies components; if `here`, they wait for `work`
            if here:
                guest.leave()

    Args:
        pool: the pool.
        relieve: called by the watchdog, in its thread, if a handler holds this thread: another thread has to take
            the loop over, with a guest of its own. The held one finds `stays` false when it comes back.
    """

    def __init__(self, pool: PoolDispatcher, relieve: Callable[[], None]) -> None:
        self._pool = pool
        self._shift = Shift(relieve)

    @property
    def stays(self) -> bool:
        """Whether this thread goes on with its loop; another one does if not."""
        return not self._shift.relieved

    def arrive(self) -> bool:
        """Take the work over until `leave`, unless another thread is at work; return whether it did."""
        return self._pool.begin_guest(self._shift)

    def work(self, until_s: float) -> bool:
        """Give the turns that wait, but none after one that ends at `until_s` (host time) or later.

        Returns:
            False if one ended that late.
        """
        return self._pool.give_turns(self._shift, until_s)

    def leave(self) -> None:
        """Leave what is still to be done to a worker."""
        self._pool.end_guest(self._shift)


STOP_PINNED_S = 0.3
"""How long, in all, a stop waits for threads whose components do not come back."""


class PinnedDispatcher(Dispatcher):
    """Gives each of its components a thread of its own, which ends with the component.

    Args:
        name: for the names of the threads.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._wakes: dict[int, SimpleQueue[bool]] = {}
        self._threads: dict[int, threading.Thread] = {}

    def attach(self, component: Runnable) -> None:
        mailbox = component.actor_inbox
        wake: SimpleQueue[bool] = SimpleQueue()
        name = component.address.rpartition("/")[2]
        thread = threading.Thread(target=self._run, args=(component, wake), name=f"{self._name}-{name}", daemon=True)
        with self._lock:
            self._wakes[id(mailbox)] = wake
            self._threads[id(component)] = thread
        thread.start()
        super().attach(component)

    def ready(self, mailbox: Mailbox) -> None:
        with self._lock:
            wake = self._wakes.get(id(mailbox))
        # If there is none, its thread has ended with the dispatcher: no thread will read this mailbox again.
        if wake is None:
            return
        wake.put(True)
        component = mailbox.component
        if component is not None and component.loop is not None:
            component.loop.interrupt()

    def _run(self, component: Runnable, wake: SimpleQueue[bool]) -> None:
        mailbox = component.actor_inbox
        while not component.actor_stopped.is_set():
            # First the look, then the loop: a thread that puts a wake interrupts the loop after that.
            if component.loop is not None and wake.empty() and component.may_await():
                component.loop.run()
            elif wake.get():
                self.give_turn(mailbox)
            else:
                break
        if component.loop is not None:
            component.loop.close()
        with self._lock:
            self._threads.pop(id(component), None)
            if self._wakes.get(id(mailbox)) is wake:
                del self._wakes[id(mailbox)]

    def stop(self) -> None:
        with self._lock:
            threads = list(self._threads.values())
            for wake in self._wakes.values():
                wake.put(False)
        for thread in threads:
            # However many are stuck: the agent has to be gone within two seconds.
            thread.join(timeout=STOP_PINNED_S / len(threads))
