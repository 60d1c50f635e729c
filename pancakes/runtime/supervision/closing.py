"""The end of a service's tasks: one after the other, the last first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

from pancakes.runtime.kernel.component import Component
from pancakes.runtime.life.life import CLOSES, State
from pancakes.runtime.life.life_event import Overdue, StopAsked
from pancakes.runtime.supervision.slot import Slot

STUCK_S: Final = 2.0
"""A task that has not ended so long after it was asked to, in host time, is stuck."""
STUCK_AT_THE_END_S: Final = 0.4
"""Where the whole agent stops, this must do: the others, wheels among them, want to be stopped in order too."""


class Closing:
    """Ends the tasks of a service before the service itself. All in the service's actor.

    Args:
        service: the service.
        feed: feeds an event to the life of a task.
        let_go: takes back what a task at rest held.
        then: called when all have ended, or are stuck.
    """

    def __init__(
        self,
        service: Component,
        feed: Callable[[Slot, StopAsked | Overdue], None],
        let_go: Callable[[Slot], None],
        then: Callable[[], None],
    ) -> None:
        self._service = service
        self._feed = feed
        self._let_go = let_go
        self._then = then
        self._left: list[Slot] = []
        self._ends: Slot | None = None

    def begin(self, slots: Iterable[Slot]) -> None:
        """Ends these tasks, the last first."""
        self._left = [slot for slot in slots if slot.life.state not in (State.STOPPED, State.REFUSED)]
        self._next()

    def _next(self) -> None:
        while self._left:
            slot = self._left.pop()
            if slot.life.at_rest:
                self._let_go(slot)
                continue
            self._ends = slot
            patience_s = STUCK_AT_THE_END_S if self._service.kernel.stopping else STUCK_S
            self._service.after_host(patience_s, partial(self._give_up, slot))
            self._feed(slot, StopAsked(reason=CLOSES))
            return
        self._ends = None
        self._then()

    def rested(self, slot: Slot) -> None:
        """A task has come to rest: the next one's turn."""
        if self._ends is slot:
            self._next()

    def _give_up(self, slot: Slot) -> None:
        """One task that does not end must not keep the others from ending."""
        if self._ends is not slot:
            return
        if slot.task is not None:
            self._feed(slot, Overdue(slot.life.incarnation))
        self._next()
