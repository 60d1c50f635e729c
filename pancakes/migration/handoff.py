"""One task's hand-off on one agent: what the core decides, carried out in order. Pure but for its rim."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pancakes.migration.core import TIMES, handle, recover
from pancakes.migration.effect import Effect, Persist, Remember
from pancakes.migration.event import Event, PersistFailed
from pancakes.migration.record import Record, TaskId
from pancakes.migration.times import Times
from pancakes.migration.volatile import Volatile


class Rim(Protocol):
    """Whoever carries effects out."""

    def carry_out(self, task_id: TaskId, effect: Effect, done: Callable[[], None]) -> None:
        """Begins to carry an effect out (never `Remember`).

        Args:
            task_id: the task that it is about.
            effect: what to do.
            done: to be called once, when the next effect may follow: for `Persist` when the record is on disk
                for good, for `StartTask` when its start has succeeded or failed, for all others at once.
                It must be called in the thread that feeds events, and may be called before this returns.
                Where a `Persist` fails, `HandOff.failed` is called instead.
        """
        ...


class HandOff:
    """Keeps one task's record and volatile part, and the order of events and effects.

    An event waits until all effects of the one before it are carried out; so the core sees them one at a
    time, as its proof assumes. All methods are called in one thread (the migrator's actor).

    Args:
        me: this agent's name.
        record: the record read from the journal; `Record(task_id)` where there is none.
        rim: who carries effects out.
        times: how long things may take.

    Attributes:
        record: the record, as it is on disk.
        volatile: what is known until the next crash.
        trouble: why the record could not be written when that was tried last; empty where it could.
    """

    def __init__(self, me: str, record: Record, rim: Rim, times: Times = TIMES) -> None:
        self.record = record
        self.volatile = Volatile()
        self.trouble = ""
        self._me = me
        self._rim = rim
        self._times = times
        # Few ever wait; and an empty deque takes 0.6 KiB, of which each task that was ever here would keep two.
        self._events: list[Event] = []
        self._effects: list[Effect] = []
        self._waiting: Effect | None = None
        self._turning = False

    @property
    def idle(self) -> bool:
        """Whether every event so far is dealt with and every effect carried out."""
        return self._waiting is None and not self._effects and not self._events

    @property
    def settled(self) -> bool:
        """Whether in addition all that was decided is on disk: nothing is left that could not be written."""
        return self.idle and self.volatile.again is None

    def recover(self) -> None:
        """Takes the task up after a restart of the agent. Called once, before any event."""
        self._effects.extend(recover(self.record, self._times))
        self._turn()

    def feed(self, event: Event) -> None:
        """Takes an event; it is dealt with as soon as those before it are."""
        self._events.append(event)
        self._turn()

    def failed(self, reason: str) -> None:
        """Says that the record given out by the last `Persist` could not be written.

        What was to follow it does not happen. The core then decides with the record that is known to hold.
        """
        if not isinstance(self._waiting, Persist):
            return
        self.trouble = reason
        event = PersistFailed(reason, self._waiting.record)
        self._waiting = None
        self._effects.clear()
        self._effects.extend(handle(self._me, self.record, self.volatile, event, self._times))
        self._turn()

    def _turn(self) -> None:
        # `done` may be called while `carry_out` still runs: a loop instead of recursion.
        if self._turning:
            return
        self._turning = True
        try:
            while self._waiting is None and (self._effects or self._events):
                if self._effects:
                    self._begin(self._effects.pop(0))
                else:
                    event = self._events.pop(0)
                    self._effects.extend(handle(self._me, self.record, self.volatile, event, self._times))
        finally:
            self._turning = False

    def _begin(self, effect: Effect) -> None:
        if isinstance(effect, Remember):
            self.volatile = effect.volatile
            return
        self._waiting = effect
        self._rim.carry_out(self.record.task_id, effect, lambda: self._done(effect))

    def _done(self, effect: Effect) -> None:
        if self._waiting is not effect:
            return
        self._waiting = None
        if isinstance(effect, Persist):
            self.record = effect.record
            self.trouble = ""
        self._turn()
