"""A pool whose steps a test can come between, and whose state it can see."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from pancakes.kernel.dispatchers import PoolDispatcher, Shift
from pancakes.kernel.mailbox import Runnable
from pancakes.util.clock import Clock


def _nothing() -> None:
    pass


class HookedLock:
    """A lock before which something else happens, once.

    Attributes:
        before: what happens before the lock is taken the next time.
    """

    def __init__(self, lock: threading.Lock) -> None:
        self._lock = lock
        self.before: Callable[[], object] = _nothing

    def __enter__(self) -> None:
        before, self.before = self.before, _nothing
        before()
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class HookedPool(PoolDispatcher):
    """Without hooks it does what any pool does.

    Attributes:
        looks: what the watchdog's thread does at each look.
        before_retire: what happens before a worker lies down, once.
        around_hold: called in the place of each step that stops counting on a thread, with that step.
        seen_dozing: called by the watchdog with whether it may rest, before it rests.
    """

    # A lock that allows no subclass.
    _lock: Any

    def __init__(self, name: str, clock: Clock, hogged: Callable[[Runnable, float], None] = lambda held, held_s: None):
        self.looks: Callable[[], int] = super().look
        self.before_retire: Callable[[], object] = _nothing
        self.around_hold: Callable[[Callable[[], None]], object] = lambda hold: hold()
        self.seen_dozing: Callable[[bool], object] = lambda dozes: None
        super().__init__(name, clock, hogged)
        self._lock = self._hooked = HookedLock(self._lock)

    @property
    def active(self) -> int:
        """How many threads the pool counts on."""
        return self._active

    @property
    def workers(self) -> int:
        """How many workers there are."""
        return len(self._workers)

    @property
    def idle(self) -> int:
        """How many workers lie down."""
        return len(self._idle)

    @property
    def dozing(self) -> bool:
        """Whether the watchdog rests."""
        return self._dozing

    @property
    def stopping(self) -> bool:
        """Whether the pool was told to stop."""
        return self._stopping

    @property
    def watched(self) -> bool:
        """Whether the watchdog's thread is there."""
        return self._watchdog.is_alive()

    def before_lock(self, happens: Callable[[], object]) -> None:
        """Lets something happen before the pool's lock is taken the next time."""
        self._hooked.before = happens

    def pass_lock(self) -> None:
        """Waits until the lock is free."""
        with self._lock:
            pass

    def name_held(self, component: Runnable, held_s: float) -> None:
        """Names a component that holds a thread, as the watchdog does."""
        self._hogged(component, held_s)

    def deafen_idle_worker(self) -> Callable[[], None]:
        """Lets the worker that is called next not hear it; returns what lets that worker hear the call."""
        worker = self._idle[-1]
        bell, worker.wake = worker.wake, threading.Lock()
        worker.wake.acquire()

        def hear() -> None:
            worker.wake = bell
            bell.release()

        return hear

    def wake_watchdog(self) -> None:
        """Wakes the watchdog where it rests."""
        with self._lock:
            self._watch_again()

    def look_now(self) -> int:
        """Looks as the watchdog does, in this thread."""
        return super().look()

    def may_doze(self) -> bool:
        """Returns whether the watchdog may rest."""
        return super()._may_doze()

    def look(self) -> int:
        return self.looks()

    def retire(self, worker: Any) -> bool:
        before, self.before_retire = self.before_retire, _nothing
        before()
        return super().retire(worker)

    def _hold(self, shift: Shift) -> None:
        hold = super()._hold
        self.around_hold(lambda: hold(shift))

    def _may_doze(self) -> bool:
        dozes = super()._may_doze()
        self.seen_dozing(dozes)
        return dozes
