"""Every component of every agent on one thread, in virtual time, in an order fixed by a seed."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from itertools import count

import msgspec

from pancakes.clock import VirtualClock
from pancakes.errors import PancakesError
from pancakes.kernel.dispatch import Dispatcher, begin_turns, end_turns
from pancakes.kernel.mailbox import Mailbox

MOST_TURNS = 1_000_000
"""More turns than this at one moment of virtual time are an endless loop."""


class VirtualCall(msgspec.Struct):
    """A call that waits for its virtual time.

    Attributes:
        function: what is called; None: nothing any more.
    """

    function: Callable[[], None] | None

    def cancel(self) -> None:
        """Makes sure that the call does not happen."""
        self.function = None


class VirtualDispatcher(Dispatcher):
    """Runs whole fleets in virtual time, twice the same for the same seed.

    Among the components that have something to do, the seed draws who goes next, so that many seeds
    try many orders. Time moves only when nobody has anything to do.

    Args:
        seed: draws the order.

    Attributes:
        clock: the virtual clock; agents use it as their host clock.
    """

    def __init__(self, seed: int = 0) -> None:
        self.clock = VirtualClock()
        self._now = self.clock.now
        self._random = random.Random(f"dispatch/{seed}")
        self._work: list[Mailbox] = []
        self._calls: list[tuple[float, int, VirtualCall]] = []
        self._numbers = count()

    def ready(self, mailbox: Mailbox) -> None:
        self._work.append(mailbox)

    def call_at(self, time_s: float, function: Callable[[], None]) -> VirtualCall:
        """Runs `function` when the clock reaches `time_s`; at the present time if that has passed."""
        call = VirtualCall(function)
        now_s = self._now()
        heapq.heappush(self._calls, (time_s if time_s > now_s else now_s, next(self._numbers), call))
        return call

    def next_s(self) -> float:
        """Returns when something happens next by itself; infinity where nothing ever will."""
        while self._calls and self._calls[0][2].function is None:
            heapq.heappop(self._calls)
        return self._calls[0][0] if self._calls else math.inf

    def settle(self) -> None:
        """Lets everybody work until nobody has anything to do at the present time.

        Raises:
            PancakesError: that never ends: somebody tells himself something again and again.
        """
        work, random, give_turn = self._work, self._random.random, self.give_turn
        turns = 0
        deferred = begin_turns()
        try:
            while work:
                turns += 1
                if turns > MOST_TURNS:
                    component = work[-1].component
                    who = component.address if component is not None else "a task between restarts"
                    raise PancakesError(
                        f"virtual time stands still at {self.clock.now()} s:"
                        f" after {MOST_TURNS} turns {who} still has work"
                    )
                if len(work) > 1:
                    index = int(random() * len(work))
                    work[index], work[-1] = work[-1], work[index]
                give_turn(work.pop(), deferred)
        finally:
            end_turns()

    def step(self) -> bool:
        """Lets everybody work, then moves to the next time at which something happens.

        Returns:
            False where nothing will ever happen again by itself.
        """
        self.settle()
        time_s = self.next_s()
        if time_s == math.inf:
            return False
        self.clock.advance_to(time_s)
        self._take_next()
        return True

    def _take_next(self) -> None:
        function = heapq.heappop(self._calls)[2].function
        if function is not None:
            function()

    def run_until(self, time_s: float) -> None:
        """Runs everything that happens up to and at `time_s`, and leaves the clock there."""
        self.run_while(lambda: True, time_s)

    def run_while(self, condition: Callable[[], bool], until_s: float) -> bool:
        """Runs while `condition` holds, no further than `until_s`.

        Returns:
            Whether the condition ceased to hold; False where the time ran out first.
        """
        work, calls, clock, settle = self._work, self._calls, self.clock, self.settle
        now_s = clock.now()
        settle()
        while condition():
            # As `step`, but without calls: this is done a few hundred times for each second of a mission.
            while calls and calls[0][2].function is None:
                heapq.heappop(calls)
            time_s = calls[0][0] if calls else math.inf
            if time_s > until_s:
                clock.advance_to(max(until_s, clock.now()))
                return False
            if time_s > now_s:
                clock.advance_to(time_s)
                now_s = time_s
            function = heapq.heappop(calls)[2].function
            assert function is not None
            function()
            if work:
                settle()
        return True
