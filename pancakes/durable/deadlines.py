"""Deadlines that share one timer, for one actor.

Putting a deadline off costs nothing: the timer stays as it was, and looks again when it fires. So leases that are
renewed all the time take one timer for each lease that passes, and not one for each task and renewal.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from pancakes.kernel.timer import OneShot

AfterHost = Callable[[float, Callable[[], None]], OneShot]


class Deadline:
    """Calls a function once its time has come, in the actor that it belongs to.

    Args:
        deadlines: those of that actor.
        function: what is called.

    Attributes:
        due_s: when, in host time; infinite: it is not set.
        function: see above.
    """

    __slots__ = ("_deadlines", "due_s", "function")

    def __init__(self, deadlines: Deadlines, function: Callable[[], None]) -> None:
        self._deadlines = deadlines
        self.function = function
        self.due_s = math.inf

    @property
    def is_set(self) -> bool:
        """Whether it will come."""
        return self.due_s < math.inf

    def set(self, delay_s: float) -> None:
        """Set it to this many seconds of host time from now, instead of any other time."""
        self._deadlines.set(self, delay_s)

    def cancel(self) -> None:
        """Make sure that it does not come."""
        self._deadlines.cancel(self)


class Deadlines:
    """The deadlines of one actor.

    Args:
        after_host: calls a function in the actor after this many seconds of host time.
        now: the host clock, in seconds.
    """

    def __init__(self, after_host: AfterHost, now: Callable[[], float]) -> None:
        self._after_host = after_host
        self._now = now
        self._set: dict[Deadline, None] = {}
        self._timer: OneShot | None = None
        self._fires_s = math.inf

    def new(self, function: Callable[[], None]) -> Deadline:
        """Return another one, which is not set."""
        return Deadline(self, function)

    def set(self, deadline: Deadline, delay_s: float) -> None:
        """See `Deadline`."""
        deadline.due_s = self._now() + delay_s
        self._set[deadline] = None
        if deadline.due_s < self._fires_s:
            self._start(deadline.due_s, delay_s)

    def cancel(self, deadline: Deadline) -> None:
        """See `Deadline`."""
        deadline.due_s = math.inf
        self._set.pop(deadline, None)
        if not self._set:
            self._stop()

    def _start(self, due_s: float, delay_s: float) -> None:
        self._stop()
        self._fires_s = due_s
        self._timer = self._after_host(delay_s, self._fired)

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._fires_s = None, math.inf

    def _fired(self) -> None:
        if self._timer is None:
            return  # called off after the timer had put this call into the actor's mailbox
        self._stop()
        now_s = self._now()
        due = [it for it in self._set if it.due_s <= now_s]
        for it in due:
            del self._set[it]
        if self._set:
            due_s = min(it.due_s for it in self._set)
            self._start(due_s, due_s - now_s)
        for it in due:
            if it.due_s <= now_s and it not in self._set:  # one that came before it may have changed it
                it.due_s = math.inf
                it.function()
