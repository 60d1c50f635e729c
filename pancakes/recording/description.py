"""What a task was at one moment of a recording: enough to run it again (`pancakes rerun`), and to tell what it read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.packet import packet_type

CHANNEL: Final = "recording"
"""What stands in a topic in place of a channel: nobody published it."""


@packet_type("task_description")
@dataclass(frozen=True, slots=True)
class TaskDescription:
    """A task, as its agent described it to the recorder.

    Attributes:
        task_id: its identity for life, `birthplace/name`; empty for a task that cannot move.
        address: its address then.
        type: the name of its class's entry point, or of its class.
        epoch: how often it had been handed over.
        mission_s: mission time at its agent.
        settings: its settings, as plain values.
        state: its state, as plain values.
        timers: its time-driven methods: `timer` and `rate_hz`.
        reads: what it subscribed to: `channel` and `types` (None: all).
        requires: the device types that it depends on.
    """

    task_id: str
    address: str
    type: str
    epoch: int
    mission_s: float
    settings: Mapping[str, Any] = field(default_factory=dict)
    state: Mapping[str, Any] = field(default_factory=dict)
    timers: tuple[Mapping[str, Any], ...] = ()
    reads: tuple[Mapping[str, Any], ...] = ()
    requires: tuple[str, ...] = ()

    @classmethod
    def of(cls, told: Mapping[str, Any], mission_s: float) -> TaskDescription:
        """Makes it of what an agent answers to `Describe(target, state=True)`.

        Raises:
            KeyError, TypeError: it is no such answer.
        """
        fence = told["fence"] or {"task_id": "", "epoch": 0}
        return cls(
            task_id=fence["task_id"],
            address=f"{told['agent']}/{told['service']}/{told['task']}",
            type=told["type"],
            epoch=fence["epoch"],
            mission_s=mission_s,
            settings=told["settings"],
            state=told["state"],
            timers=tuple({"timer": timer["timer"], "rate_hz": timer["rate_hz"]} for timer in told["timers"]),
            reads=tuple({"channel": reads["channel"], "types": reads["types"]} for reads in told["reads"]),
            requires=tuple(told["requires"]),
        )

    def reads_packet(self, channel: str, type_name: str) -> bool:
        """Returns whether it subscribed to packets of a type on a channel."""
        return any(
            reads["channel"] == channel and (reads["types"] is None or type_name in reads["types"])
            for reads in self.reads
        )
