"""Run all components of all agents on one thread, in virtual time, in an order that a seed fixes."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from itertools import count

import msgspec

from pancakes.errors import PancakesError
from pancakes.kernel.dispatchers import Dispatcher
from pancakes.kernel.mailbox import Mailbox
from pancakes.util.clock import VirtualClock

MOST_TURNS = 1_000_000
"""More turns than this at one moment of virtual time are an endless loop."""


class VirtualCall(msgspec.Struct):
    """A call that waits for its virtual time.

    Attributes:
        function: what is called; None: nothing any more.
    """

    function: Callable[[], None] | None

    def cancel(self) -> None:
        """Make sure that the call does not happen."""
        self.function = None


class VirtualDispatcher(Dispatcher):
    """Runs whole fleets in virtual time, twice the same for the same seed.

    Among the components that have something to do, the seed draws the next one, so that many seeds
    try many orders. Time moves only when no component has anything to do.

    Args:
        seed: draws the order.

    Attributes:
        clock: the virtual clock; agents use it as their host clock.
    """

    def __init__(self, seed: int = 0) -> None:
        self.clock = VirtualClock()
        self._random = random.Random(f"dispatch/{seed}")
        self._work: list[Mailbox] = []
        self._calls: list[tuple[float, int, VirtualCall]] = []  # a heap: when, the how many-th of all, and what
        self._numbers = count()

    def ready(self, mailbox: Mailbox) -> None:
        self._work.append(mailbox)

    def call_at(self, time_s: float, function: Callable[[], None]) -> VirtualCall:
        """Run `function` when the clock reaches `time_s`; at the present time if that has passed."""
        call = VirtualCall(function)
        if time_s < math.inf:  # else it never comes
            now_s = self.clock.now_s
            heapq.heappush(self._calls, (time_s if time_s > now_s else now_s, next(self._numbers), call))
        return call

    def next_s(self) -> float:
        """Return when something happens next by itself; infinity if nothing ever will."""
        calls = self._calls
        while calls and calls[0][2].function is None:
            heapq.heappop(calls)
        return calls[0][0] if calls else math.inf

    def settle(self) -> None:
        """Give turns until no component has anything to do at the present time.

        Raises:
            PancakesError: that never ends: a component tells itself something again and again.
        """
        work, draw = self._work, self._random.random
        for _ in range(MOST_TURNS):
            if not work:
                return
            if len(work) > 1:
                index = int(draw() * len(work))
                work[index], work[-1] = work[-1], work[index]
            self.give_turn(work.pop())
        if not work:
            return
        component = work[-1].component
        name = component.address if component is not None else "a task between restarts"
        raise PancakesError(
            f"virtual time does not get past {self.clock.now()} s: after {MOST_TURNS} turns {name} still has work"
        )

    def step(self) -> bool:
        """Give the turns that wait, then do the next thing that happens, and give the turns that come of it.

        Returns:
            False if nothing will ever happen again by itself.
        """
        self.settle()
        next_s = self.next_s()
        if next_s == math.inf:
            return False
        once = iter((False, True))
        self.run_until(next_s, lambda: next(once))
        return True

    def run_until(self, time_s: float, reached: Callable[[], bool] = lambda: False) -> bool:
        """Run everything that happens up to and at `time_s`, and leave the clock there; or until something is reached.

        Args:
            time_s: how far to run.
            reached: returns whether to stop; it is asked after each event.

        Returns:
            Whether that was reached; False if the time ran out first.
        """
        calls, clock, work = self._calls, self.clock, self._work
        self.settle()
        while not reached():
            if not calls or calls[0][0] > time_s:
                clock.now_s = max(time_s, clock.now_s)
                return False
            at_s, _, call = heapq.heappop(calls)
            function = call.function
            if function is None:  # called off
                continue
            clock.now_s = at_s
            function()
            if work:
                self.settle()
        return True
