"""The timers of all actors of an agent, for what looks at them from outside."""

from __future__ import annotations

import threading

from pancakes.runtime.kernel.mailbox import Runnable
from pancakes.runtime.kernel.task_timer import TaskTimer


class TimerTable:
    """Which timers tick here. Each actor enters its own; metrics, recordings and descriptions read them. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._timers: dict[str, tuple[TaskTimer, ...]] = {}

    def add(self, timer: TaskTimer) -> None:
        """Enters a timer of an actor that runs."""
        address = timer.component.address
        with self._lock:
            self._timers[address] = (*self._timers.get(address, ()), timer)

    def remove(self, component: Runnable) -> None:
        """Strikes the timers of an actor out, which has ended."""
        with self._lock:
            timers = self._timers.get(component.address, ())
            if timers and timers[0].component is component:
                del self._timers[component.address]

    def of(self, address: str) -> tuple[TaskTimer, ...]:
        """Returns the timers of the actor that runs at an address, in the order of its class."""
        return self._timers.get(address, ())

    def all(self) -> list[TaskTimer]:
        """Returns all timers, in the order in which their actors started."""
        with self._lock:
            return [timer for timers in self._timers.values() for timer in timers]
