"""What the census, the agent and the services that host tasks tell each other: data."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.mesh.migration.boots import Boot
from pancakes.mesh.migration.claim import OwnerClaim
from pancakes.mesh.migration.knowledge import TasksKnown
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
        boot: its boot.
    """

    peer: str
    boot: Boot


class Owns(msgspec.Struct, frozen=True):
    """A service tells the census that this agent owns a task.

    Attributes:
        owned: the task, and under which epoch.
        peer: the neighbour that is to know; empty: all of them.
    """

    owned: OwnerClaim
    peer: str = ""


class AskAbout(msgspec.Struct, frozen=True):
    """A service has the census ask neighbours what they know of tasks.

    Attributes:
        peers: the neighbours; empty: all of them.
        task_ids: the tasks.
    """

    peers: tuple[str, ...]
    task_ids: tuple[TaskId, ...]


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


class NeighbourCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks that another agent can be asked from now on.

    Attributes:
        peer: the other agent.
    """

    peer: str


class FactsCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks what another agent knows of tasks.

    Attributes:
        peer: the other agent.
        told: what it says.
    """

    peer: str
    told: TasksKnown


class CopyNoticed(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks that another agent takes the disk of this one for an old copy.

    Attributes:
        peer: the other agent.
    """

    peer: str


CensusNews = ClaimsCame | NeighbourCame | FactsCame | CopyNoticed
"""What the census tells a service that hosts tasks."""
