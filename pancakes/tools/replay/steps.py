"""What a task got, and what was done to it: the steps of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pancakes.events import Event
from pancakes.packet import Packet

CHANGES: Final = ("rate_changed", "settings_changed", "task_frozen", "task_resumed")
"""The events of a service that say what was done to a task while it ran."""


@dataclass(frozen=True, slots=True)
class Given:
    """A packet that the task got.

    Attributes:
        time_s: mission time at which it was handled, as far as its effects tell; else when it was published.
        published_s: mission time at which it was published on the task's agent.
        packet: the packet.
        letter: whether it was addressed to the task wherever it was, past all subscriptions.
    """

    time_s: float
    published_s: float
    packet: Packet
    letter: bool


@dataclass(frozen=True, slots=True)
class Change:
    """Something that was done to the task.

    Attributes:
        time_s: mission time.
        event: the event that told of it; one of `CHANGES`.
    """

    time_s: float
    event: Event
