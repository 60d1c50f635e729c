"""A thread of another part that gives the pool's turns while no other thread does.

So what the timer's or the network's thread brings costs no hop to a worker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from pancakes.runtime.kernel.pool import PoolDispatcher
from pancakes.runtime.kernel.shift import Shift

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
        relieve: called by the watchdog, in its thread, where a handler holds this thread: another thread has to take
            the loop over, with a guest of its own. The held one finds `stays` false when it comes back.
    """

    def __init__(self, pool: PoolDispatcher, relieve: Callable[[], None]) -> None:
        self._pool = pool
        self._shift = Shift(relieve)

    @property
    def stays(self) -> bool:
        """Whether this thread goes on with its loop; another one does where not."""
        return not self._shift.relieved

    def arrive(self) -> bool:
        """Takes the work over until `leave`, unless another thread is at work. Returns whether it did."""
        return self._pool.begin_guest(self._shift)

    def work(self, until_s: float) -> None:
        """Gives the turns that wait, but none after `until_s` (host time)."""
        if self._pool.work and self._pool.clock.now() < until_s:
            self._pool.give_turns(self._shift, until_s)

    def leave(self) -> None:
        """Leaves what is still to be done to a worker."""
        self._pool.end_guest(self._shift)
