"""Reach agents from a program that is not an agent: a script, a notebook, the command line (docs/client.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pancakes.client.client import Client
from pancakes.client.rates import RateMeter
from pancakes.client.rows import AgentRow, EventRow, ReceivedPacket, TaskRow
from pancakes.client.session import Replies, Survey, Where
from pancakes.client.subscriptions import Subscriber
from pancakes.migration import Ledger

if TYPE_CHECKING:
    from pancakes.client.async_client import AsyncClient, AsyncSubscriber

__all__ = [
    "AgentRow",
    "AsyncClient",
    "AsyncSubscriber",
    "Client",
    "EventRow",
    "ReceivedPacket",
    "Ledger",
    "RateMeter",
    "Replies",
    "Subscriber",
    "Survey",
    "TaskRow",
    "Where",
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
