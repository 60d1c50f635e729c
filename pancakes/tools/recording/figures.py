"""Figures of an agent's tasks and links that no packet tells, sampled once a second for a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import astuple

from pancakes.packet import packet_type
from pancakes.runtime.foundation import codecs
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.task_timer import TaskTimer
from pancakes.tools.recording.description import is_described
from pancakes.tools.recording.latenesses import TickRun


class TimerFigures(msgspec.Struct, frozen=True):
    """A time-driven method of a task; counts since the task was started.

    Attributes:
        timer: the method.
        rate_hz: the rate that is asked for.
        ticks: how often it was called.
        missed: how many ticks were left out.
        lateness_sum_s: how late all ticks were together, in mission time.
        lateness_max_s: how late the latest was, in mission time.
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
        task_id: its identity for life; empty where it cannot move.
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
    """A link to another agent; counts since it stands.

    Attributes:
        peer: the other agent.
        rtt_s: its smoothed round trip, in host time; None where it is not known yet.
        packets_out: packets sent.
        bytes_out: bytes sent, those of the link's own messages too.
        packets_in: packets received.
        bytes_in: bytes received.
        dropped: packets that fell out because the peer was slow.
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
        links: each link that stands.
        undelivered: packets that no subscriber took.
        dead_letters: packets whose handler failed.
    """

    mission_s: float
    tasks: tuple[OneTask, ...]
    links: tuple[OneLink, ...] = ()
    undelivered: int = 0
    dead_letters: int = 0


class TimerTicks(msgspec.Struct, frozen=True):
    """Ticks of one timer of a task.

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
    """Returns the ticks that ran.

    Args:
        number: see `TaskTicks`.
        runs: see `Latenesses`.
        task_id: only those of the task with this identity; empty: of all tasks that a recording describes.
    """
    told = []
    for timer, own in runs.items():
        address, fence = timer.component.address, getattr(timer.component, "fence", None)
        wanted = fence is not None and fence.task_id == task_id if task_id else is_described(address.partition("/")[2])
        if wanted:
            told.append(TimerTicks(address, timer.method, tuple(astuple(run) for run in own)))
    return TaskTicks(number, tuple(told))


def figures_of(kernel: Kernel, latenesses: Mapping[TaskTimer, Mapping[int, int]]) -> TaskFigures:
    """Returns the figures of an agent as they stand. Any thread: it reads them, and waits for no actor.

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
    told = ({**peer, "peer": peer["name"], "dropped": sum(peer["dropped"].values())} for peer in kernel.links())
    links = tuple(codecs.convert(row, OneLink) for row in told)
    return TaskFigures(kernel.mission.now(), tuple(tasks), links, kernel.stream.undelivered, kernel.dead_letters.count)
