"""Every component of every agent on one thread, in virtual time, in an order fixed by a seed."""

from __future__ import annotations

import heapq
import math
import random
from collections import deque
from collections.abc import Callable
from itertools import count

import msgspec

from pancakes.clock import VirtualClock
from pancakes.errors import PancakesError
from pancakes.kernel.dispatch import Dispatcher, Turns, turns_of_thread
from pancakes.kernel.mailbox import Mailbox

MOST_TURNS = 1_000_000
"""More turns than this at one moment of virtual time are an endless loop."""
SOON_S = 0.001
"""What is to be called so soon comes most often in the order of its times, and then needs no heap, which takes three
times as long. Two thirds of a mission's calls are such: what travels between agents that hear each other well.
"""


class VirtualCall(msgspec.Struct):
    """A call that waits for its virtual time.

    Attributes:
        function: what is called; None: nothing any more.
    """

    function: Callable[[], None] | None

    def cancel(self) -> None:
        """Makes sure that the call does not happen."""
        self.function = None


_Entry = tuple[float, int, VirtualCall]
"""When, the how many-th of all, and what; never two with the same number."""


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
        self._random = random.Random(f"dispatch/{seed}")
        self._work: list[Mailbox] = []
        # What is to be called: in a heap; and what comes next in a row, if it came in the order of its times.
        self._calls: list[_Entry] = []
        self._row: deque[_Entry] = deque()
        self._numbers = count()

    def ready(self, mailbox: Mailbox) -> None:
        self._work.append(mailbox)

    def call_at(self, time_s: float, function: Callable[[], None]) -> VirtualCall:
        """Runs `function` when the clock reaches `time_s`; at the present time if that has passed."""
        call = VirtualCall(function)
        row = self._row
        now_s = self.clock.now_s
        if time_s < now_s:
            time_s = now_s
        if time_s - now_s <= SOON_S and not (row and time_s < row[-1][0]):
            row.append((time_s, next(self._numbers), call))
        elif time_s < math.inf:  # else it never comes
            heapq.heappush(self._calls, (time_s, next(self._numbers), call))
        return call

    def next_s(self) -> float:
        """Returns when something happens next by itself; infinity where nothing ever will."""
        calls, row = self._calls, self._row
        while calls and calls[0][2].function is None:
            heapq.heappop(calls)
        while row and row[0][2].function is None:
            row.popleft()
        return min(calls[0][0] if calls else math.inf, row[0][0] if row else math.inf)

    def settle(self) -> None:
        """Lets everybody work until nobody has anything to do at the present time.

        Raises:
            PancakesError: that never ends: somebody tells himself something again and again.
        """
        if self._work:
            self._settle(turns_of_thread())

    def _settle(self, turns: Turns) -> None:
        """Lets everybody work, where somebody has something to do."""
        work, draw, give_turn, deferred = self._work, self._random.random, self.give_turn, turns.deferred
        turns.given = True
        try:
            for _ in range(MOST_TURNS):
                if len(work) > 1:
                    index = int(draw() * len(work))
                    work[index], work[-1] = work[-1], work[index]
                give_turn(work.pop(), deferred)
                if not work:
                    return
        finally:
            turns.given = False
        component = work[-1].component
        who = component.address if component is not None else "a task between restarts"
        raise PancakesError(
            f"virtual time stands still at {self.clock.now()} s: after {MOST_TURNS} turns {who} still has work"
        )

    def step(self) -> bool:
        """Lets everybody work, then does the next thing that happens, and lets everybody work again.

        Returns:
            False where nothing will ever happen again by itself.
        """
        self.settle()
        next_s = self.next_s()
        if next_s == math.inf:
            return False
        once = iter((True, False))
        self.run_while(lambda: next(once), next_s)
        return True

    def run_until(self, time_s: float) -> None:
        """Runs everything that happens up to and at `time_s`, and leaves the clock there."""
        self.run_while(lambda: True, time_s)

    def run_while(self, condition: Callable[[], bool], until_s: float) -> bool:
        """Runs while `condition` holds, no further than `until_s`.

        Returns:
            Whether the condition ceased to hold; False where the time ran out first.
        """
        calls, row, work, clock, settle = self._calls, self._row, self._work, self.clock, self._settle
        turns = turns_of_thread()
        if work:
            settle(turns)
        while condition():
            # What comes next.
            if row and not (calls and calls[0] < row[0]):
                time_s, _, call = row[0]
                if time_s > until_s:
                    break
                row.popleft()
            elif calls:
                time_s, _, call = calls[0]
                if time_s > until_s:
                    break
                heapq.heappop(calls)
            else:
                break
            function = call.function
            if function is None:  # called off
                continue
            if time_s > clock.now_s:
                clock.now_s = time_s
            function()
            if work:
                settle(turns)
        else:
            return True
        clock.now_s = max(until_s, clock.now_s)
        return False
