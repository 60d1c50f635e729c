"""A deadline that is put off again and again before it comes."""

from __future__ import annotations

import math
from collections.abc import Callable

from pancakes.runtime.kernel.timer import OneShot

AfterHost = Callable[[float, Callable[[], None]], OneShot]


class Deadline:
    """Calls a function once its time has come, in the actor that it belongs to.

    Putting it off costs nothing: its timer stays as it was, and looks again when it fires. So a lease that is renewed
    all the time takes one timer for each lease that passes, and not one for each renewal.

    Args:
        after_host: calls a function in the actor in so many seconds of host time.
        now: the host clock, in seconds.
        function: what is called.
    """

    def __init__(self, after_host: AfterHost, now: Callable[[], float], function: Callable[[], None]) -> None:
        self._after_host = after_host
        self._now = now
        self._function = function
        self._due_s = math.inf
        self._timer: OneShot | None = None
        self._fires_s = math.inf

    def set(self, delay_s: float) -> None:
        """Sets it to so many seconds of host time from now, instead of any other time."""
        self._due_s = self._now() + delay_s
        if self._due_s < self._fires_s:
            self._start(delay_s)

    def cancel(self) -> None:
        """Makes sure that it does not come."""
        self._due_s = self._fires_s = math.inf
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _start(self, delay_s: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._fires_s = self._now() + delay_s
        self._timer = self._after_host(delay_s, self._fired)

    def _fired(self) -> None:
        if self._timer is None:
            return  # called off after the timer had put this call into the actor's mailbox
        self._timer, self._fires_s = None, math.inf
        left_s = self._due_s - self._now()
        if left_s > 0.0:
            self._start(left_s)
        else:
            self._due_s = math.inf
            self._function()
