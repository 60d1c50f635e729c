"""The ticks of one time-driven method (paper §3.2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pancakes.kernel.handlers import Period, Tick

if TYPE_CHECKING:
    from pancakes.kernel.component import Component


class TaskTimer:
    """One time-driven method of one component: what stands between the timer's thread and the actor.

    Attributes:
        deadline_s: the deadline of the tick that is pending, in mission time.
        missed: how many ticks before it never came.
        pending: whether a tick waits to be run.
    """

    __slots__ = (
        "_handler",
        "_kernel",
        "component",
        "deadline_s",
        "lateness_max_s",
        "lateness_sum_s",
        "mailbox",
        "method",
        "missed",
        "missed_total",
        "pending",
        "period_s",
        "ticks",
    )

    def __init__(self, component: Component, method: str, period: Period) -> None:
        self.component = component
        self.method = method
        self.period_s = period.period_s
        # Of the class, and called with the component: one object for all tasks of it, and none for each.
        self._handler: Callable[[Component, Tick], None] = getattr(type(component), method)
        self._kernel = component.kernel
        self.mailbox = component.actor_inbox
        self.deadline_s = 0.0
        self.pending = False
        self.missed = 0
        self.missed_total = 0
        self.ticks = 0
        self.lateness_sum_s = 0.0
        self.lateness_max_s = 0.0

    @property
    def rate_hz(self) -> float:
        """Ticks for each second of mission time."""
        return 1.0 / self.period_s

    def describe(self) -> dict[str, Any]:
        """Returns what is to be known about it, as plain values. Any thread."""
        return {
            "timer": self.method,
            "rate_hz": self.rate_hz,
            "ticks": self.ticks,
            "missed": self.missed_total,
            "lateness_mean_s": self.lateness_sum_s / self.ticks if self.ticks else 0.0,
            "lateness_max_s": self.lateness_max_s,
        }

    def fire(self, deadline_s: float, missed: int) -> None:
        """A deadline has come (the timer's thread). A tick that still waits is replaced, never joined by another."""
        # In this order: a turn may run the waiting tick meanwhile, and must not be given this one twice.
        if self.pending:
            self.missed += 1 + missed
            self.deadline_s = deadline_s
            return
        self.arm(deadline_s, missed)
        self.mailbox.put(self)

    def arm(self, deadline_s: float, missed: int) -> None:
        """Gives it the deadline that `run` is for; where no tick is pending, and one is then."""
        self.missed += missed
        self.deadline_s = deadline_s
        self.pending = True

    def run(self) -> None:
        """Calls the method (the component's turn)."""
        deadline_s = self.deadline_s
        missed, self.missed = self.missed, 0
        self.pending = False
        if self.mailbox.paused:
            return
        kernel, handler = self._kernel, self._handler
        now = kernel.now
        lateness_s = now() - deadline_s
        if lateness_s < 0.0:
            lateness_s = 0.0
        self.ticks += 1
        if missed:
            self.missed_total += missed
        self.lateness_sum_s += lateness_s
        if lateness_s > self.lateness_max_s:
            self.lateness_max_s = lateness_s
        if kernel.lateness_heard:
            for heard in kernel.lateness_heard:
                heard((self, lateness_s))
        handler(self.component, Tick(deadline_s, missed, lateness_s))
