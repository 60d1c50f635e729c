"""Reach agents from a program that is not an agent: a script, a notebook, the command line (docs/client.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pancakes.client.client import Client
from pancakes.client.rates import RateMeter
from pancakes.client.rows import AgentInfo, EventInfo, ReceivedPacket, TaskInfo
from pancakes.client.session import FleetDescription, Replies, Target
from pancakes.client.subscriptions import Subscriber
from pancakes.migration import MigrationReport

if TYPE_CHECKING:
    from pancakes.client.async_client import AsyncClient, AsyncSubscriber

__all__ = [
    "AgentInfo",
    "AsyncClient",
    "AsyncSubscriber",
    "Client",
    "EventInfo",
    "ReceivedPacket",
    "MigrationReport",
    "RateMeter",
    "Replies",
    "Subscriber",
    "FleetDescription",
    "TaskInfo",
    "Target",
]


def __getattr__(name: str) -> Any:
    """Import asyncio only if it is used: its import takes longer than all the rest of a short command."""
    if name == "AsyncClient":
        from pancakes.client.async_client import AsyncClient

        return AsyncClient
    if name == "AsyncSubscriber":
        from pancakes.client.async_client import AsyncSubscriber

        return AsyncSubscriber
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
