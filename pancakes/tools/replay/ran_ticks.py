"""Which ticks of a task ran in a stay, as far as its recording tells. Pure."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from typing import Final

from pancakes.events import Event
from pancakes.runtime.kernel.handlers import Tick
from pancakes.tools.recording.figures import TaskTicks
from pancakes.tools.recording.latenesses import NEAR_S, TickRun
from pancakes.tools.recording.recorded_packet import RecordedPacket
from pancakes.tools.replay.stays import Stay

UNKNOWN_TICKS: Final = (
    "the recording does not tell which ticks ran: what the task says in ticks that its host missed then, or gave it"
    " late, may differ"
)


class RanTicks:
    """The ticks of one timer that ran.

    Args:
        period_s: the period that the task was described with.
        runs: the ticks that ran.
        complete: whether no tick ran after these.
    """

    def __init__(self, period_s: float, runs: Iterable[TickRun], complete: bool) -> None:
        self._period_s = period_s
        self._runs = sorted(runs, key=lambda run: run.first_s)
        self._firsts_s = [run.first_s - NEAR_S for run in self._runs]
        self._complete = complete

    def tick_at(self, deadline_s: float, period_s: float) -> Tick | None:
        """Returns a tick as the task was given it, with its lateness if it was late; None: it did not run.

        A tick that the recording cannot tell of counts as one that ran: the timer had another period then, or the
        recording ends before.
        """
        after = bisect_right(self._firsts_s, deadline_s)
        if after:
            run = self._runs[after - 1]
            number = round((deadline_s - run.first_s) / run.period_s) if run.period_s else 0
            if number < run.count and abs(run.first_s + number * run.period_s - deadline_s) < NEAR_S:
                return Tick(deadline_s) if number else Tick(deadline_s, run.missed, run.lateness_s)
        if after == len(self._runs) and not self._complete:
            return Tick(deadline_s)
        periods_s = [run.period_s for run in self._runs[max(0, after - 1) : after + 1]] or [self._period_s]
        return None if any(math.isclose(period_s, then_s) for then_s in periods_s) else Tick(deadline_s)


class TicksReader:
    """Collects what a recording tells of the ticks of a stay."""

    def __init__(self, stay: Stay) -> None:
        self._stay = stay
        self._runs: dict[str, list[TickRun]] = {}
        self._number = 0
        self._told = False
        self._holes = False
        self._complete = False
        self._over = False

    def take(self, entry: RecordedPacket) -> None:
        """Takes an entry of the recording; in the order of time."""
        stay, packet = self._stay, entry.packet
        if self._over or entry.agent != stay.agent:
            return
        if isinstance(packet.body, TaskTicks):
            self._take_ticks(entry.time_ns, packet.body)
        elif isinstance(packet.body, Event) and packet.body.kind == "recording_started":
            if packet.source == f"{stay.agent}/log/Recorder":  # another recording
                self._number = 0
                self._over = entry.time_ns >= stay.to_ns

    def _take_ticks(self, time_ns: int, told: TaskTicks) -> None:
        stay = self._stay
        follows, self._number = told.number == self._number + 1, told.number
        if time_ns <= stay.from_ns or (time_ns > stay.to_ns and not stay.end):
            return
        self._told = True
        self._holes |= not follows
        for timer in told.timers:
            if timer.address == stay.task.address:
                self._runs.setdefault(timer.timer, []).extend(TickRun(*run) for run in timer.runs)
        # If the recording ends before the task does, this is its last entry, made after all others.
        self._complete = self._over = time_ns >= stay.to_ns

    def ticks(self) -> dict[str, RanTicks] | None:
        """Returns the ticks that ran, by timer; None: the recording does not tell."""
        if not self._told or self._holes:
            return None
        periods_s = {it["timer"]: 1.0 / it["rate_hz"] if it["rate_hz"] else math.inf for it in self._stay.task.timers}
        return {
            timer: RanTicks(period_s, self._runs.get(timer, ()), self._complete)
            for timer, period_s in periods_s.items()
        }
