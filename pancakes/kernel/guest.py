"""A thread of somebody else's that gives the pool's turns while nobody else does, which saves the hop to a worker.

It is the way of nearly every tick and of every packet from another agent. A tick takes 0.61 µs by `tick`, and 1.3 by
way of its task's mailbox.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from pancakes.kernel.dispatch import Deferred, begin_turns, end_turns, run_deferred
from pancakes.kernel.shift import Shift
from pancakes.kernel.task_timer import TaskTimer

if TYPE_CHECKING:
    from pancakes.kernel.pool import PoolDispatcher

GUEST_S = 0.002
"""A guest, who has duties of his own, should not work longer."""
TICKS_CHECK = 2
"""A guest looks whether his time is up after his first tick and after each two more, and after each turn that is no
tick. A look takes 0.05 µs of a tick's 0.6; were it after each four, four slow ticks would hold up who must be on time.
"""


class Guest:
    """A thread that is not the pool's, but may give turns while nobody else does: without a hop to a worker.

    Its loop:

        while guest.stays:
            ...                          # wait
            here = guest.arrive()
            ...                          # what readies components; if `here`, they wait for `turn` or `work`
            if here:
                guest.leave()

    Args:
        pool: whose guest it is.
        relieve: called by the watchdog, in its thread, where a handler holds this thread: another thread has to take
            the loop over, with a guest of its own. The held one finds `stays` false when it comes back.
    """

    def __init__(self, pool: PoolDispatcher, relieve: Callable[[], None]) -> None:
        self._pool = pool
        self._shift = Shift(relieve)
        self._deferred: Deferred = []

    @property
    def stays(self) -> bool:
        """Whether this thread goes on with its loop; another one does where not."""
        return not self._shift.relieved

    def arrive(self) -> bool:
        """Takes the work over, if nobody is at work, until `leave`."""
        if not self._pool.welcome(self._shift):
            return False
        self._deferred = begin_turns()
        return True

    def turn(self) -> bool:
        """Gives a turn to whoever has waited longest, if anybody waits. Returns whether this thread still `stays`."""
        if self._deferred:  # by what this thread did between turns; a turn may take long
            run_deferred(self._deferred, None)
        self._pool.give_turns(self._shift, self._deferred, -math.inf)
        return not self._shift.relieved

    def tick(self, timers: Iterator[TaskTimer], deadline_s: float, missed: int, until_s: float) -> bool:
        """Ticks those who are left in `timers`, one after the other with its turn, until about `until_s`.

        Who has nothing else to do takes the tick at once and not by way of its mailbox: half of the calls, and less to
        fetch from memory for each of a thousand tasks that were at rest. After each tick whoever has waited longest
        gets a turn, too.

        Returns:
            Whether this thread still `stays`. If so, what is left in `timers` is late, and to be ticked without turns.
        """
        pool, shift, deferred = self._pool, self._shift, self._deferred
        work, now = pool.work, pool.clock.now
        if deferred:
            run_deferred(deferred, None)
        if now() >= until_s:
            return True
        look = 1
        for timer in timers:
            mailbox = timer.mailbox
            if mailbox.dispatch is not pool or timer.pending or not mailbox.take_token():
                timer.fire(deadline_s, missed)
            elif mailbox.control or mailbox.component is not timer.component:
                # What waits goes first, and who has ended gets none.
                timer.fire(deadline_s, missed)
                mailbox.dispatch.ready(mailbox)
            else:
                # As `timer.arm`, without the call.
                timer.missed += missed
                timer.deadline_s = deadline_s
                timer.pending = True
                shift.turns += 1
                shift.mailbox = mailbox
                timer.component.take_tick(timer, deferred)
                shift.mailbox = None
                if shift.held:
                    pool.come_back(shift)
                    if shift.relieved:
                        return False
            look -= 1
            if work:
                if not self.turn():
                    return False
                look = 0
            if look <= 0:
                if now() >= until_s:
                    return True
                look = TICKS_CHECK
        return True

    def work(self, until_s: float) -> None:
        """Gives the turns that wait, but none after `until_s` (host time)."""
        pool = self._pool
        if self._deferred:
            run_deferred(self._deferred, None)
        if pool.work and pool.clock.now() < until_s:
            pool.give_turns(self._shift, self._deferred, until_s)

    def leave(self) -> None:
        """Leaves what is still to be done to a worker."""
        end_turns()
        run_deferred(self._deferred, None)
        self._pool.farewell(self._shift)
