"""Who gives a pool's turns: one of its workers, or a guest; and for how long at a time."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.kernel.mailbox import Mailbox

SLICE_S = 0.002
"""A turn ends after this time even if more waits, so that others get theirs. Beside a task that always has more to do,
a control packet's reply takes two or three turns: 6.4 ms (p50) with this, and 18 with 5 ms.
"""


class Shift:
    """Somebody who gives the pool's turns, and what the watchdog knows about him.

    Attributes:
        mailbox: whose turn he gives now.
        turns: how many he has given.
        relieve: for a guest: lets somebody else see to his own duties.
        relieved: whether that has been done.
        here: whether he is at work, or called to it; under the pool's lock.
        held: whether he is not reckoned with though he is here, because he does not get on.
        seen: the number of the turn at which the watchdog saw him last.
        seen_s: for how long, in seconds, it has seen him at that one.
        named: whether it has said who holds him in that turn.
    """

    __slots__ = ("held", "here", "mailbox", "named", "relieve", "relieved", "seen", "seen_s", "turns")

    def __init__(self, relieve: Callable[[], None] | None = None) -> None:
        self.mailbox: Mailbox | None = None
        self.turns = 0
        self.relieve = relieve
        self.relieved = False
        self.here = False
        self.held = False
        self.seen = -1
        self.seen_s = 0.0
        self.named = False

    def see(self, passed_s: float) -> float:
        """Returns for how long the watchdog has seen him at one and the same turn; `passed_s` since it looked last."""
        if self.turns != self.seen:
            self.seen = self.turns
            self.seen_s = 0.0
            self.named = False
        else:
            self.seen_s += passed_s
        return self.seen_s
