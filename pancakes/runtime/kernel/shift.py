"""A thread that gives a pool's turns, as the watchdog sees it."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.runtime.kernel.mailbox import Mailbox


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
        """Returns for how long the watchdog has seen it at one and the same turn; `passed_s` since the last look."""
        if self.turns != self._seen:
            self._seen = self.turns
            self._seen_s = 0.0
            self.named = False
        else:
            self._seen_s += passed_s
        return self._seen_s
