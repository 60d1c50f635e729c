"""One packet of a recording."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.packet import Packet
from pancakes.runtime.clock import SET_SINCE_S

NANOSECONDS: Final = 1_000_000_000


def date_of(time_ns: int, timespec: str = "seconds", sep: str = " ") -> str:
    """Returns a time of a recording as a date for people, in UTC."""
    if time_ns < SET_SINCE_S * NANOSECONDS:
        return "not known: the clock of the machine was not set"
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(sep, timespec)


class RecordingError(PancakesError):
    """A recording cannot be written or read; the message names the file."""


class RecordedPacket(msgspec.Struct, frozen=True, gc=False):
    """One packet as it was seen.

    Attributes:
        time_ns: when it was recorded, in nanoseconds: since 1970 where agents run live, since the agents were made
            in virtual time.
        agent: the agent on whose channel it was seen; a packet that travels is seen on the agent that sends it, and
            on the agent that gets it.
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
        """The identity for life of the task that published it, whichever agent it was on; empty where none did."""
        return self.packet.fence.task_id if self.packet.fence is not None else ""
