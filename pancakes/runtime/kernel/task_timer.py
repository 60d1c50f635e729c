"""The ticks of one time-driven method (paper §3.2)."""

from __future__ import annotations

from collections.abc import Callable
from time import thread_time
from typing import Any, Protocol, TypeAlias

from pancakes.runtime.kernel.handlers import Tick
from pancakes.runtime.kernel.mailbox import Runnable
from pancakes.runtime.kernel.turn_meter import TurnMeter

HeardTick: TypeAlias = "tuple[TaskTimer, Tick, float]"
"""A timer, a tick of it that runs now, and the timer's period in seconds. A plain tuple: it is made in each tick."""


class Ticker(Protocol):
    """What a timer needs of the kernel."""

    ticks_heard: tuple[Callable[[HeardTick], None], ...]
    meter: TurnMeter | None

    def now(self) -> float:
        """Returns the mission time in seconds."""


class TaskTimer:
    """One time-driven method of one component: what stands between the timer's thread and the actor.

    Args:
        component: the component.
        method: the method's name.
        handler: the method.
        period_s: from tick to tick, in mission time; infinity lets it rest.
        ticker: the clock, and what is told of each tick.

    Attributes:
        deadline_s: the deadline of the tick that is pending, in mission time.
        missed: how many ticks before it never came.
        pending: whether a tick waits to be run.
    """

    __slots__ = (
        "_handler",
        "_ticker",
        "component",
        "deadline_s",
        "lateness_max_s",
        "lateness_sum_s",
        "method",
        "missed",
        "missed_total",
        "pending",
        "period_s",
        "ticks",
    )

    def __init__(
        self, component: Runnable, method: str, handler: Callable[[Any, Tick], None], period_s: float, ticker: Ticker
    ) -> None:
        self.component = component
        self.method = method
        self.period_s = period_s
        self._handler = handler
        self._ticker = ticker
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
        self.missed += missed
        self.deadline_s = deadline_s
        self.pending = True
        self.component.actor_inbox.put(self)

    def run(self) -> None:
        """Calls the method (the component's turn)."""
        deadline_s = self.deadline_s
        missed, self.missed = self.missed, 0
        self.pending = False
        if self.component.actor_inbox.paused or not self.component.acts():
            return
        lateness_s = max(0.0, self._ticker.now() - deadline_s)
        self.ticks += 1
        self.missed_total += missed
        self.lateness_sum_s += lateness_s
        self.lateness_max_s = max(lateness_s, self.lateness_max_s)
        tick = Tick(deadline_s, missed, lateness_s)
        for heard in self._ticker.ticks_heard:
            heard((self, tick, self.period_s))
        meter = self._ticker.meter
        begun_s = thread_time() if meter is not None else 0.0
        self._handler(self.component, tick)
        if meter is not None:
            meter.tick(self.component.address, self.method, thread_time() - begun_s)
