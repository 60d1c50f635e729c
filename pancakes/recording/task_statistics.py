"""Statistics of an agent's tasks and links that no packet tells: rates, lateness, which ticks ran, drops, traffic.

They are sampled once a second for a recording, in the recorder's thread, which reads them and waits for no actor.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec
from msgspec import Struct
from msgspec.structs import astuple

from pancakes.kernel.handlers import Tick
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.timer import HeardTick, TaskTimer
from pancakes.packet import packet_type
from pancakes.recording.records import is_described
from pancakes.util import codecs

STEP: Final = 2.0**0.25
"""The upper edge of a bucket is this many times that of the bucket below: a quantile is right to within 10 %."""
LEAST_S: Final = 1e-6
"""The lowest bucket, number 0, reaches up to here."""
MOST: Final = 100_000
"""At most this many ticks wait to be counted: a second of a thousand tasks at 100 Hz."""
NEAR_S: Final = 1e-6
"""Deadlines closer than this are equal: computed from the first and the period, they are approximate."""
LATE_PERIODS: Final = 0.5
"""A tick is late that came later than this share of its period, ..."""
LATE_S: Final = 0.25
"""... or than this, in mission time."""


def bucket_of(lateness_s: float) -> int:
    """Return the number of the bucket that a lateness belongs to."""
    return max(0, math.ceil(4.0 * math.log2(lateness_s / LEAST_S))) if lateness_s > LEAST_S else 0


def quantile_s(counts: Mapping[int, int], share: float) -> float | None:
    """Return the lateness that this share of all ticks stayed below.

    Args:
        counts: how many ticks there were in each bucket.
        share: from 0 to 1.

    Returns:
        The middle of the bucket that it lies in, in seconds; 0 in the lowest; None if there was no tick.
    """
    left = share * sum(counts.values())
    for bucket, count in sorted(counts.items()):
        left -= count
        if left <= 0:
            return LEAST_S * STEP ** (bucket - 0.5) if bucket else 0.0
    return None


class TickRun(Struct, gc=False):
    """Consecutive ticks of a timer, of which only the first may be late or follow missed ones.

    Attributes:
        first_s: the deadline of the first, in mission time.
        period_s: from one to the next; 0 if the timer rested already when the only one ran.
        count: how many they are.
        missed: how many ticks before the first were missed, as its tick reported.
        lateness_s: how late the first was, in mission time; 0 if it was not late, as all others were not.
    """

    first_s: float
    period_s: float
    count: int
    missed: int
    lateness_s: float = 0.0

    @classmethod
    def begun_by(cls, tick: Tick, period_s: float) -> TickRun:
        """Return a run of one tick."""
        return cls(tick.time_s, period_s, 1, tick.missed, tick.lateness_s if _is_late(tick, period_s) else 0.0)

    def goes_on_with(self, tick: Tick, period_s: float) -> bool:
        """Return whether a tick is the next one of the run."""
        next_s = self.first_s + self.count * self.period_s
        near = period_s == self.period_s and abs(next_s - tick.time_s) < NEAR_S
        return near and not tick.missed and not _is_late(tick, period_s)


def _is_late(tick: Tick, period_s: float) -> bool:
    return tick.lateness_s > min(LATE_PERIODS * period_s, LATE_S)


class Latenesses:
    """Count ticks by their lateness, and note their deadlines, in the recorder's thread.

    Attributes:
        heard: takes a tick, in the task's turn. It is a list's `append`, because each further call would delay the
            tick.
        runs: the ticks that `take` counted last, by timer; in order.
        overflowed: whether some ticks before these were lost, because too many waited.
    """

    def __init__(self) -> None:
        self._heard: deque[HeardTick] = deque(maxlen=MOST)
        self.heard: Callable[[HeardTick], None] = self._heard.append
        self.runs: dict[TaskTimer, list[TickRun]] = {}
        self.overflowed = False

    def take(self) -> Mapping[TaskTimer, Mapping[int, int]]:
        """Return how many ticks there were in each bucket since the last time, by timer."""
        counts: dict[TaskTimer, Counter[int]] = {}
        runs = self.runs = {}
        waiting = len(self._heard)
        self.overflowed = waiting == MOST
        for _ in range(waiting):
            try:
                timer, tick, period_s = self._heard.popleft()
            except IndexError:  # an old one fell out just now
                break
            counts.setdefault(timer, Counter())[bucket_of(tick.lateness_s)] += 1
            period_s = period_s if period_s < math.inf else 0.0
            own = runs.setdefault(timer, [])
            if own and own[-1].goes_on_with(tick, period_s):
                own[-1].count += 1
            else:
                own.append(TickRun.begun_by(tick, period_s))
        return counts


class TimerFigures(msgspec.Struct, frozen=True):
    """A time-driven method of a task; counts since the task was started.

    Attributes:
        timer: the method.
        rate_hz: the rate that is asked for.
        ticks: the number of calls.
        missed: the number of skipped ticks.
        lateness_sum_s: the sum of the lateness of all ticks, in mission time.
        lateness_max_s: the largest lateness, in mission time.
        lateness_counts: of the ticks since the sample before, how many were how late: the number of the bucket (see
            `latenesses.bucket_of`) and the count, in order.
    """

    timer: str
    rate_hz: float
    ticks: int
    missed: int
    lateness_sum_s: float
    lateness_max_s: float
    lateness_counts: tuple[tuple[int, int], ...] = ()


class OneTask(msgspec.Struct, frozen=True):
    """A task that runs.

    Attributes:
        task: its name, as `service/task`.
        task_id: its identity for life; empty if it cannot move.
        incarnation: how often it was started.
        waiting: how many packets wait in its mailbox.
        dropped: how many packets it has lost so far, on channels of which it wants more than the newest.
        timers: its time-driven methods.
    """

    task: str
    task_id: str
    incarnation: int
    waiting: int
    dropped: int
    timers: tuple[TimerFigures, ...]


class OneLink(msgspec.Struct, frozen=True):
    """A link to another agent; counts since it came up.

    Attributes:
        peer: the other agent.
        rtt_s: its smoothed round trip, in host time; None if it is not known yet.
        packets_out: packets sent.
        bytes_out: bytes sent, those of the link's own messages too.
        packets_in: packets received.
        bytes_in: bytes received.
        dropped: packets that were dropped because the peer was slow.
    """

    peer: str
    rtt_s: float | None
    packets_out: int
    bytes_out: int
    packets_in: int
    bytes_in: int
    dropped: int


@packet_type("task_figures")
class TaskFigures(msgspec.Struct, frozen=True):
    """The figures of an agent's tasks and links.

    Attributes:
        mission_s: mission time.
        tasks: each task that runs and has a timer, or has lost a packet.
        links: each link that is up.
        undelivered: packets that no subscriber took.
        dead_letters: packets whose handler failed.
    """

    mission_s: float
    tasks: tuple[OneTask, ...]
    links: tuple[OneLink, ...] = ()
    undelivered: int = 0
    dead_letters: int = 0


class TimerTicks(msgspec.Struct, frozen=True):
    """The ticks of one timer of a task.

    Attributes:
        address: the task's address.
        timer: the method.
        runs: the ticks that ran one after the other: the deadline of the first and their period, in mission time, how
            many they are, how many ticks were missed before the first, and how late that was if it was late (see
            `latenesses.TickRun`).
    """

    address: str
    timer: str
    runs: tuple[tuple[float, float, int, int, float], ...]


@packet_type("task_ticks")
class TaskTicks(msgspec.Struct, frozen=True):
    """The ticks of an agent's tasks that ran since the message before. Not in virtual time: there all of them run.

    Attributes:
        number: counts the messages of a recording; one is left out if some ticks are not known.
        timers: each timer that ticked, also of tasks that have ended since.
    """

    number: int
    timers: tuple[TimerTicks, ...]


def ticks_of(number: int, runs: Mapping[TaskTimer, Sequence[TickRun]], task_id: str = "") -> TaskTicks:
    """Return the ticks that ran.

    Args:
        number: see `TaskTicks`.
        runs: see `Latenesses`.
        task_id: only those of the task with this identity; empty: of all tasks that a recording describes.
    """
    ticks = []
    for timer, own in runs.items():
        address, fence = timer.component.address, getattr(timer.component, "fence", None)
        wanted = fence is not None and fence.task_id == task_id if task_id else is_described(address.partition("/")[2])
        if wanted:
            ticks.append(TimerTicks(address, timer.method, tuple(astuple(run) for run in own)))
    return TaskTicks(number, tuple(ticks))


def figures_of(kernel: Kernel, latenesses: Mapping[TaskTimer, Mapping[int, int]]) -> TaskFigures:
    """Return the figures of an agent as they stand. Any thread: it reads them, and waits for no actor.

    Args:
        kernel: the agent's kernel.
        latenesses: see `Latenesses.take`.
    """
    tasks = []
    for task in kernel.tasks.all():
        timers = kernel.task_timers.of(task.address)
        dropped = task.mailbox.dropped()
        if not timers and not dropped:
            continue
        tasks.append(
            OneTask(
                f"{task.service}/{task.name}",
                task.task_id,
                task.life.incarnation,
                sum(len(queue) for queue in list(task.mailbox.queues.values())),
                dropped,
                tuple(
                    TimerFigures(
                        timer.method,
                        timer.rate_hz,
                        timer.ticks,
                        timer.missed_total,
                        timer.lateness_sum_s,
                        timer.lateness_max_s,
                        tuple(sorted(latenesses.get(timer, {}).items())),
                    )
                    for timer in timers
                ),
            )
        )
    rows = ({**peer, "peer": peer["name"], "dropped": sum(peer["dropped"].values())} for peer in kernel.links())
    links = tuple(codecs.convert(row, OneLink) for row in rows)
    return TaskFigures(kernel.mission.now(), tuple(tasks), links, kernel.stream.undelivered, kernel.dead_letters.count)
