"""A packet that a program heard on a channel of an agent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar, cast

from pancakes.packet import Packet

Body = TypeVar("Body")


@dataclass(frozen=True, slots=True)
class HeardPacket(Generic[Body]):
    """A packet that came.

    Attributes:
        agent: on whose channel it was published.
        packet: the packet; its destination is this program.
        at_s: when it came, in host time (`Client.now`).
    """

    agent: str
    packet: Packet
    at_s: float

    @property
    def body(self) -> Body:
        """What it says: an instance of its type's class, or a plain mapping where the type is not known here."""
        return cast("Body", self.packet.body)

    @property
    def type(self) -> str:
        """The name of its type, such as `battery`."""
        return self.packet.type

    @property
    def source(self) -> str:
        """The address of its publisher, `agent/service/task`."""
        return self.packet.source

    @property
    def stamp_s(self) -> float:
        """When it was published, in mission seconds of its publisher's agent."""
        return self.packet.stamp
