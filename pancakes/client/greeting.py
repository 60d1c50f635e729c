"""Finds out which agent is at an address: its name and its fleet, which a link to it needs beforehand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from pancakes.mesh.net.transport import Connection, ConnectionHandler, Transport
from pancakes.mesh.wire.link import Link, LinkTimes, Over
from pancakes.mesh.wire.link_messages import Hello, Identity
from pancakes.runtime.clock import Clock

_NOBODY: Final = Identity("greeting", "greeting", role="client").hello()
"""Only to have a link; it is never sent, so the agent there refuses nothing."""

Told = Callable[[Hello | str], None]
"""Takes what the agent said about itself, or the reason why nothing is known. In the transport's thread, once."""


class Greeting(ConnectionHandler):
    """Connects to an address, listens to the hello that every agent begins with, and goes.

    Args:
        transport: how bytes travel.
        address: where to.
        clock: the host clock.
        told: see `Told`.
    """

    def __init__(self, transport: Transport, address: str, clock: Clock, told: Told) -> None:
        self._told: Told | None = told
        self._now = clock.now
        self._link = Link(_NOBODY, LinkTimes(), clock.now())
        self._connection: Connection | None = None
        transport.dial(address, self)

    def opened(self, connection: Connection) -> None:
        """See `Handler`."""
        self._connection = connection

    def received(self, data: bytes) -> None:
        """See `Handler`."""
        actions = self._link.receive(data, self._now())
        if self._link.peer is not None:
            self._tell(self._link.peer)
        elif actions and isinstance(actions[-1], Over):
            self._tell(actions[-1].reason)

    def closed(self, reason: str) -> None:
        """See `Handler`."""
        self._tell(reason)

    def _tell(self, what: Hello | str) -> None:
        told, self._told = self._told, None
        if told is None:
            return
        told(what)
        if self._connection is not None:
            self._connection.close()
