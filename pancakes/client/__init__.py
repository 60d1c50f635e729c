"""How programs that are no agents reach agents: a script, a notebook, the command line (docs/client.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pancakes.client.agent_row import AgentRow
from pancakes.client.event_row import EventRow
from pancakes.client.fleet_client import Client
from pancakes.client.heard_packet import HeardPacket
from pancakes.client.looks import Looks
from pancakes.client.subscriber import Subscriber
from pancakes.client.survey import Replies, Survey
from pancakes.client.task_row import TaskRow
from pancakes.client.where import Where
from pancakes.mesh.migration.ledger import Ledger

if TYPE_CHECKING:
    from pancakes.client.async_client import AsyncClient
    from pancakes.client.async_subscriber import AsyncSubscriber

__all__ = [
    "AgentRow",
    "AsyncClient",
    "AsyncSubscriber",
    "Client",
    "EventRow",
    "HeardPacket",
    "Ledger",
    "Looks",
    "Replies",
    "Subscriber",
    "Survey",
    "TaskRow",
    "Where",
]


def __getattr__(name: str) -> Any:
    """Imports asyncio only where it is used: it takes longer than all the rest of a short command."""
    if name == "AsyncClient":
        from pancakes.client.async_client import AsyncClient

        return AsyncClient
    if name == "AsyncSubscriber":
        from pancakes.client.async_subscriber import AsyncSubscriber

        return AsyncSubscriber
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
