"""The contents of a recording: packets as they were seen, and descriptions of the tasks.

`pancakes rerun` needs the descriptions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.packet import Packet, packet_type
from pancakes.util.clock import SET_SINCE_S

NANOSECONDS: Final = 1_000_000_000


def date_of(time_ns: int, timespec: str = "seconds", sep: str = " ") -> str:
    """Return a time of a recording as a date for people, in UTC."""
    if time_ns < SET_SINCE_S * NANOSECONDS:
        return "not known: the clock of the machine was not set"
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(sep, timespec)


class RecordingError(PancakesError):
    """A recording cannot be written or read; the message names the file."""


class RecordedPacket(msgspec.Struct, frozen=True, gc=False):
    """One packet as it was seen.

    Attributes:
        time_ns: when it was recorded, in nanoseconds: since 1970 if agents run live, since the agents were made in
            virtual time.
        agent: the agent on whose channel it was seen; a packet between agents is seen on the sender and on the
            receiver.
        packet: the packet.
    """

    time_ns: int
    agent: str
    packet: Packet

    @property
    def topic(self) -> str:
        """The MCAP topic that it belongs to."""
        return f"/{self.agent}/{self.packet.channel}/{self.packet.type}"

    @property
    def task_id(self) -> str:
        """The permanent identity of the task that published it; empty if it was not a task."""
        return self.packet.fence.task_id if self.packet.fence is not None else ""


CHANNEL: Final = "recording"
"""The channel in topics of messages that the recorder itself writes."""


@packet_type("task_description")
class TaskDescription(msgspec.Struct, frozen=True):
    """A task, as its agent described it to the recorder.

    Attributes:
        task_id: its identity for life, `birthplace/name`; empty for a task that cannot move.
        address: its address then.
        type: the name of its class's entry point, or of its class.
        epoch: the number of the epoch under which its agent owned it.
        mission_s: its agent's mission time at this description.
        settings: its settings, as plain values.
        state: its state, as plain values.
        timers: its time-driven methods: `timer` and `rate_hz`.
        reads: what it subscribed to: `channel` and `types` (None: all).
        requires: the device types that it depends on.
        time_ns: the time of this description, on the recording's clock.
        began: where the recording saw it start: when that was (`time_ns`, `mission_s`), and what it began with
            (`settings` and `state`, both without what the class itself says; `periods_s` of its timers, `rate_hz` of
            its configuration). None if it ran already.
        seed: of the random numbers of its agent.
    """

    task_id: str
    address: str
    type: str
    epoch: int
    mission_s: float
    settings: Mapping[str, Any] = msgspec.field(default_factory=dict)
    state: Mapping[str, Any] = msgspec.field(default_factory=dict)
    timers: tuple[Mapping[str, Any], ...] = ()
    reads: tuple[Mapping[str, Any], ...] = ()
    requires: tuple[str, ...] = ()
    time_ns: int = 0
    began: Mapping[str, Any] | None = None
    seed: int = 0

    @classmethod
    def of(cls, answer: Mapping[str, Any], time_ns: Callable[[float], int], seed: int, seen: bool) -> TaskDescription:
        """Make it from an agent's answer to `Describe(target, state=True, began=seen)`.

        Args:
            answer: the answer.
            time_ns: turns the agent's host time, in seconds, into the recording's.
            seed: of the random numbers of the agent.
            seen: whether the recording saw the task start.

        Raises:
            KeyError, TypeError: it is not such an answer.
        """
        fence = answer["fence"] or {"task_id": "", "epoch": 0}
        return cls(
            task_id=fence["task_id"],
            address=f"{answer['agent']}/{answer['service']}/{answer['task']}",
            type=answer["type"],
            epoch=fence["epoch"],
            mission_s=answer["mission_s"],
            settings=answer["settings"],
            state=answer["state"],
            timers=tuple({"timer": timer["timer"], "rate_hz": timer["rate_hz"]} for timer in answer["timers"]),
            reads=tuple({"channel": reads["channel"], "types": reads["types"]} for reads in answer["reads"]),
            requires=tuple(answer["requires"]),
            time_ns=time_ns(answer["host_s"]),
            began=_began(answer["began"], time_ns) if seen else None,
            seed=seed,
        )

    def reads_packet(self, channel: str, type_name: str) -> bool:
        """Return whether it subscribed to packets of a type on a channel."""
        return any(
            reads["channel"] == channel and (reads["types"] is None or type_name in reads["types"])
            for reads in self.reads
        )


def _began(answer: Mapping[str, Any], time_ns: Callable[[float], int]) -> dict[str, Any]:
    began = {key: value for key, value in answer.items() if key != "host_s"}
    return {**began, "time_ns": time_ns(answer["host_s"])}


def is_described(target: str) -> bool:
    """Return whether recordings describe a task, given as `service/task`: not an agent's own tasks."""
    return not target.startswith(("log/", "network/", "device/"))
