"""Figures of an agent's tasks and links that no packet tells, sampled once a second for a recording."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from pancakes.packet import packet_type
from pancakes.runtime.foundation import codecs
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.task_timer import TaskTimer


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
