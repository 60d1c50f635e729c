"""What the census, the agent and the services that host tasks tell each other: data."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.mesh.migration.claim import OwnerClaim
from pancakes.mesh.migration.record import TaskId
from pancakes.runtime.kernel.reference import Reference

CENSUS: Final = "kernel/Census"
"""Where on each agent the census is."""


class NetworkBegan(msgspec.Struct, frozen=True):
    """The Network Service tells the census that packets can go to other agents from now on."""


class NeighbourUp(msgspec.Struct, frozen=True):
    """The agent tells the census that a link to another agent stands.

    Attributes:
        peer: the other agent.
    """

    peer: str


class Owns(msgspec.Struct, frozen=True):
    """A service tells the census that this agent owns a task.

    Attributes:
        owned: the task, and under which epoch.
        peer: the neighbour that is to know; empty: all of them.
    """

    owned: OwnerClaim
    peer: str = ""


class HostBegan(msgspec.Struct, frozen=True):
    """A service that hosts tasks tells the census that it has begun: it is told the claims of other agents.

    Attributes:
        service: the service.
    """

    service: Reference


class ClaimsCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks what another agent says that it owns.

    Attributes:
        peer: the other agent.
        claims: its claims, by task.
    """

    peer: str
    claims: dict[TaskId, OwnerClaim]
