"""What the agent, the root and the services tell each other: data."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from pancakes.packet import Packet
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.life.request import Request
from pancakes.runtime.supervision.task_messages import Carried


class Close(msgspec.Struct, frozen=True):
    """The root tells a service to stop its tasks and to end, or the agent the root to stop its services and to end.

    Attributes:
        for_s: after so many seconds of mission time the root starts the service again; None: it does not by itself.
    """

    for_s: float | None = None


class ServiceReady(msgspec.Struct, frozen=True):
    """A service tells the root that all tasks that start with it run, or do not.

    Attributes:
        service: the service's actor.
    """

    service: Reference


class ServiceEnded(msgspec.Struct, frozen=True):
    """A service tells the root that it has ended.

    Attributes:
        service: the service's actor.
        error: why, where it failed; None: it was told to end.
        kept: what its tasks carried last, by their names, for its next start.
        unheard: the requests that it has not answered.
    """

    service: Reference
    error: BaseException | None
    kept: Mapping[str, Carried]
    unheard: tuple[Request, ...]


class NoRoom(msgspec.Struct, frozen=True):
    """The agent tells the root that a control packet from elsewhere found no room here, or does not fit its type.

    Attributes:
        packet: the packet.
        reason: why it was refused, as a sentence.
    """

    packet: Packet
    reason: str


class PeerDown(msgspec.Struct, frozen=True):
    """The agent tells the services that have to do with other agents that one has gone.

    Attributes:
        peer: the other agent.
    """

    peer: str
