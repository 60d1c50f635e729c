"""The start of a service's tasks: a few at a time, until it is decided of each whether it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Final

from pancakes.runtime.kernel.component import Component
from pancakes.runtime.supervision.slot import Slot

STARTED_AT_ONCE: Final = 64
"""So many tasks of a service start in one turn."""


class Startup:
    """Starts the tasks that start with their service. All in the service's actor.

    In one turn ten thousand would occupy a thread of the pool for half a second, and fight with those that run already
    for the interpreter. What is asked of a task meanwhile waits.

    Args:
        service: the service.
        at_once: so many of its tasks it starts in one turn.
        start: starts one of them.
        ready: called once it is decided of each whether it runs.
    """

    def __init__(
        self, service: Component, at_once: int, start: Callable[[Slot], None], ready: Callable[[], None]
    ) -> None:
        self._service = service
        self._at_once = at_once
        self._start = start
        self._ready = ready
        self._unsettled: set[str] = set()
        self._unstarted: set[str] = set()

    def begin(self, slots: Sequence[Slot]) -> None:
        """Starts these tasks, in this order."""
        self._unsettled = {slot.name for slot in slots}
        self._unstarted = set(self._unsettled)
        if slots:
            self._start_some(iter(slots))
        else:
            self._ready()

    def _start_some(self, slots: Iterator[Slot]) -> None:
        some = list(islice(slots, self._at_once))
        for slot in some:
            self._unstarted.discard(slot.name)
            self._start(slot)
        if len(some) == self._at_once:
            self._service.call(partial(self._start_some, slots))

    def is_to_start(self, slot: Slot) -> bool:
        """Returns whether the turn of a task to start has not come yet."""
        return slot.name in self._unstarted

    def settled(self, slot: Slot) -> None:
        """The start of a task is decided."""
        if slot.name in self._unsettled:
            self._unsettled.discard(slot.name)
            if not self._unsettled:
                self._ready()
