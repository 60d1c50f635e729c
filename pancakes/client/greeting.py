"""Finds out which agent is at an address: its name, which an agent tells to those of its fleet alone."""

from __future__ import annotations

import uuid
from collections.abc import Callable

from pancakes.mesh.net.transport import Connection, ConnectionHandler, Transport
from pancakes.mesh.wire.framing import frame
from pancakes.mesh.wire.link import Link, LinkTimes, Over, SendMessage
from pancakes.mesh.wire.link_messages import Hello, Identity
from pancakes.runtime.clock import Clock

Told = Callable[[Hello | str], None]
"""Takes what the agent said about itself, or the reason why nothing is known. In the transport's thread, once."""


class Greeting(ConnectionHandler):
    """Connects to an address, says hello, listens to the agent's hello, and goes.

    Args:
        transport: how bytes travel.
        address: where to.
        name: the name under which it says hello, as a client.
        fleet: the fleet of which the agent is to be.
        clock: the host clock.
        told: see `Told`.
    """

    def __init__(self, transport: Transport, address: str, name: str, fleet: str, clock: Clock, told: Told) -> None:
        self._told: Told | None = told
        self._now = clock.now
        own = Identity(name, str(uuid.uuid4()), fleet=fleet, role="client").hello()
        self._link = Link(own, LinkTimes(), clock.now())
        self._connection: Connection | None = None
        transport.dial(address, self)

    def opened(self, connection: Connection) -> None:
        """See `Handler`."""
        self._connection = connection
        for action in self._link.open(self._now()):
            if isinstance(action, SendMessage):
                connection.send(frame([action.message]))

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
