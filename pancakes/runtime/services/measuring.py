"""How the root answers `Measure`: it notes what was counted, and again after the time that was asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from pancakes.errors import ControlRefused
from pancakes.measurement import LONGEST_S, SHORTEST_S
from pancakes.runtime.foundation.processors import host_id, processor_count, processor_times, yardstick_s
from pancakes.runtime.hosting.load import processor_time_s
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.task_table import TaskEntry
from pancakes.runtime.kernel.turn_meter import NOTHING, MeterReading, TurnMeter


@dataclass(frozen=True)
class _Mark:
    """All that is counted, at one moment."""

    host_s: float
    processor_s: float
    busy_s: float
    whole_s: float
    yardstick_s: float
    battery: float | None
    meter: MeterReading
    missed: dict[tuple[str, str], int]


class Measuring:
    """A part of the root: the measurements that are under way, in its actor.

    Args:
        root: the root.
        battery: returns what is left of the agent's battery; None: it has none, or has not read it.
    """

    def __init__(self, root: Component, battery: Callable[[], float | None]) -> None:
        self._root = root
        self._kernel: Kernel = root.kernel
        self._battery = battery
        self._under_way = 0

    def begin(self, for_s: float, done: Callable[[dict[str, Any]], None]) -> None:
        """Begins a measurement.

        Args:
            for_s: how long it takes, in host time.
            done: called with its result, in the root's actor.

        Raises:
            ControlRefused: it takes no time, or too long; or the agent lives in virtual time.
        """
        if not (SHORTEST_S <= for_s <= LONGEST_S) or math.isnan(for_s):
            raise ControlRefused(f"a measurement takes from {SHORTEST_S:g} to {LONGEST_S:g} s, not {for_s:g} s")
        if self._kernel.virtual is not None:
            raise ControlRefused(f"{self._kernel.agent} lives in virtual time, in which no processor time is measured")
        if self._kernel.meter is None:
            self._kernel.meter = TurnMeter()
        self._under_way += 1
        self._root.after_host(for_s, partial(self._end, self._kernel.meter, self._mark(self._kernel.meter), done))

    def _mark(self, meter: TurnMeter) -> _Mark:
        busy_s, whole_s = processor_times()
        missed = {(it.component.address, it.method): it.missed_total for it in self._kernel.task_timers.all()}
        quick_s = min(yardstick_s(), yardstick_s())
        now_s, battery = self._kernel.host.now(), self._battery()
        return _Mark(now_s, processor_time_s(), busy_s, whole_s, quick_s, battery, meter.read(), missed)

    def _end(self, meter: TurnMeter, before: _Mark, done: Callable[[dict[str, Any]], None]) -> None:
        after = self._mark(meter)
        self._under_way -= 1
        if not self._under_way:
            self._kernel.meter = None
        turns = {
            address: (count - was[0], used_s - was[1])
            for address, (count, used_s) in after.meter.turns.items()
            for was in (before.meter.turns.get(address, (0, 0.0)),)
        }
        whole_s = after.whole_s - before.whole_s
        done(
            {
                "agent": self._kernel.agent,
                "speed": self._kernel.mission.speed,
                "span_s": after.host_s - before.host_s,
                "processor_s": after.processor_s - before.processor_s,
                "turns": sum(count for count, _ in turns.values()),
                "turn_s": sum(used_s for _, used_s in turns.values()),
                "host": {
                    "id": host_id(),
                    "processors": processor_count(),
                    "busy_share": min(1.0, (after.busy_s - before.busy_s) / whole_s) if whole_s > 0.0 else 0.0,
                    "yardstick_s": min(before.yardstick_s, after.yardstick_s),
                },
                "battery": {"before": before.battery, "after": after.battery},
                "tasks": [self._task(entry, turns, before, after) for entry in self._kernel.tasks.all()],
            }
        )

    def _task(
        self, entry: TaskEntry, turns: dict[str, tuple[int, float]], before: _Mark, after: _Mark
    ) -> dict[str, Any]:
        count, used_s = turns.get(entry.address, (0, 0.0))
        timers = []
        for timer in self._kernel.task_timers.of(entry.address):
            key = (entry.address, timer.method)
            was, now = before.meter.ticks.get(key, NOTHING), after.meter.ticks.get(key, NOTHING)
            timers.append(
                {
                    "timer": timer.method,
                    "rate_hz": timer.rate_hz,
                    "ticks": now[0] - was[0],
                    # It counts from 0 again where the task began anew meanwhile.
                    "missed": max(0, after.missed.get(key, 0) - before.missed.get(key, 0)),
                    "tick_s": now[1] - was[1],
                    "tick_s2": now[2] - was[2],
                }
            )
        return {
            "service": entry.service,
            "task": entry.name,
            "type": entry.type,
            "state": entry.life.word,
            "task_id": entry.task_id,
            "turns": count,
            "turn_s": used_s,
            "timers": timers,
        }
