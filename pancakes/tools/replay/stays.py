"""Where each task was in the course of a recording, and for how long. Pure: entries go in, stays come out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from pancakes.events import Event
from pancakes.packet import LOG
from pancakes.runtime.foundation.suggestion import did_you_mean
from pancakes.tools.recording.description import TaskDescription
from pancakes.tools.recording.recorded_packet import RecordedPacket, RecordingError

STOPPED: Final = "stopped"
FAILED: Final = "failed"
ENDS: Final = {"task_stopped": STOPPED, "task_failed": FAILED}
"""The events of a service that say that a task has ended, and how."""


@dataclass
class Stay:
    """A time that one actor of a task spent on one agent, from its start or from when the recording began.

    Attributes:
        agent: the agent.
        task: what the task was at the beginning.
        from_ns: when it began, as the recording counts time.
        to_ns: when it ended, or the recording.
        end: `stopped`, `failed`, or empty where the recording ended first.
        reason: why it ended.
    """

    agent: str
    task: TaskDescription
    from_ns: int
    to_ns: int
    end: str = ""
    reason: str = ""

    @property
    def task_id(self) -> str:
        """What the task is called: its identity for life, or its address where it has none."""
        return self.task.task_id or self.task.address

    @property
    def whole(self) -> bool:
        """Whether the recording saw it start."""
        return self.task.began is not None

    @property
    def begins_s(self) -> float:
        """The mission time at which it began."""
        return float(self.task.began["mission_s"]) if self.task.began is not None else self.task.mission_s

    @property
    def service(self) -> str:
        """The address of the task's service."""
        return self.task.address.rpartition("/")[0]

    @property
    def name(self) -> str:
        """The task's name."""
        return self.task.address.rpartition("/")[2]


def find_stays(entries: Iterable[RecordedPacket]) -> list[Stay]:
    """Returns all stays in a recording, in the order in which they began.

    Args:
        entries: the recording, in the order of time.
    """
    found: list[Stay] = []
    open_: dict[str, Stay] = {}  # by the task's address, which names its agent
    last_ns: dict[str, int] = {}

    def close(stay: Stay, to_ns: int, end: str = "", reason: str = "") -> None:
        stay.to_ns, stay.end, stay.reason = to_ns, end, reason
        del open_[stay.task.address]

    for entry in entries:
        body = entry.packet.body
        if isinstance(body, TaskDescription):
            before = open_.get(body.address)
            from_ns = body.began["time_ns"] if body.began is not None else body.time_ns
            if before is not None:
                close(before, from_ns)
            stay = open_[body.address] = Stay(entry.agent, body, from_ns, from_ns)
            found.append(stay)
        elif entry.packet.channel == LOG and isinstance(body, Event):
            if body.kind == "recording_started" and entry.packet.source == f"{entry.agent}/log/Recorder":
                # Another recording of this agent: what was between the two was seen by none.
                for stay in [stay for stay in open_.values() if stay.agent == entry.agent]:
                    close(stay, last_ns[entry.agent])
            ended = open_.get(f"{entry.packet.source}/{body.fields.get('task')}")
            if ended is not None and body.kind in ENDS:
                reason = str(body.fields.get("error") or body.fields.get("reason") or "")
                close(ended, entry.time_ns, ENDS[body.kind], reason)
        last_ns[entry.agent] = entry.time_ns
    for stay in list(open_.values()):
        close(stay, max(last_ns[stay.agent], stay.from_ns))
    return sorted(found, key=lambda stay: (stay.from_ns, stay.task.address))


def choose_stays(stays: Sequence[Stay], task: str, agent: str = "", number: int | None = None) -> list[Stay]:
    """Returns the stays of one task.

    Args:
        stays: all stays in a recording.
        task: the task's identity for life (`birthplace/name`), its address (`agent/service/name`), or its name where
            only one task bears it.
        agent: only those on this agent; empty: on any.
        number: only one of them, from 1.

    Raises:
        RecordingError: there is no such task, or there are several; or no such stay.
    """
    if not stays:
        raise RecordingError(
            "the recording does not say what its tasks were: it is of another kind, or of some channels only"
            " (pancakes record start without --channel and --type, or with --task)"
        )
    known = list(dict.fromkeys(stay.task_id for stay in stays))
    meant = list(dict.fromkeys(stay.task_id for stay in stays if task in (stay.task_id, stay.task.address)))
    meant = meant or [task_id for task_id in known if task_id.rpartition("/")[2] == task]
    if not meant:
        names = [*known, *(task_id.rpartition("/")[2] for task_id in known)]
        hint = did_you_mean(task, names, otherwise=f", only {', '.join(known)}")
        raise RecordingError(f"the recording has no task {task!r}{hint}")
    if len(meant) > 1:
        raise RecordingError(f"the recording has several tasks {task!r}: say {' or '.join(meant)}")
    there = [stay for stay in stays if stay.task_id == meant[0]]
    chosen = [stay for stay in there if agent in ("", stay.agent)]
    if not chosen:
        agents = ", ".join(dict.fromkeys(stay.agent for stay in there))
        raise RecordingError(f"{meant[0]} was never on {agent!r} in the recording, only on {agents}")
    if number is None:
        return chosen
    if number > len(chosen):
        stayed = f"{len(chosen)} stays" if len(chosen) > 1 else "one stay"
        raise RecordingError(f"{meant[0]} has only {stayed} in the recording" + (f" on {agent}" if agent else ""))
    return [chosen[number - 1]]
