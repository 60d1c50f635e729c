"""The world's end of the hardware bus."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.bodies.sim.bus import Reply, Request, RequestReader, encode
from pancakes.errors import RemoteProtocolError
from pancakes.mesh.net.transport import Connection, ConnectionHandler, Transport

Serve = Callable[[Request], Reply | None]
Call = Callable[[Callable[[], None]], None]
Log = Callable[[str, str], None]


class BusServer:
    """Takes requests from simulated devices and carries them to the actor that owns the world.

    Args:
        transport: where connections come in.
        call: runs a function in the world's actor, later, from any thread.
        serve: answers a request; called in the world's actor.
        log: takes (level, text); called from the transport's thread.
    """

    def __init__(self, transport: Transport, call: Call, serve: Serve, log: Log) -> None:
        self._transport = transport
        self.call = call
        self.serve: Serve | None = serve
        self.log = log
        self.clients: dict[_BusConnection, None] = {}
        self._address = ""

    def listen(self, address: str) -> str:
        """Takes connections at `address` from now on; returns the address that was really taken.

        Raises:
            PancakesError: the address is in use, or is no address.
        """
        self._address = self._transport.listen(address, lambda: _BusConnection(self))
        return self._address

    def close(self) -> None:
        """Answers nothing more, frees its address, and closes the connections: so the devices learn of it.

        A world that is started again can listen there.
        """
        self.serve = None
        if self._address:
            self._transport.stop_listening(self._address)
            self._address = ""
        for client in tuple(self.clients):
            client.close("the world has ended")


class _BusConnection(ConnectionHandler):
    """One agent's devices, at the end of a connection. Lives in the transport's thread."""

    def __init__(self, server: BusServer) -> None:
        self._server = server
        self._reader = RequestReader()
        self._connection: Connection | None = None

    def opened(self, connection: Connection) -> None:
        self._connection = connection
        self._server.clients[self] = None
        if self._server.serve is None:
            self.close("the world has ended")

    def received(self, data: bytes) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            requests = self._reader.feed(data)
        except RemoteProtocolError as error:
            self._server.log("warning", f"the hardware bus closes the connection from {connection.remote}: {error}")
            self.close(str(error))
            return
        if requests:
            self._server.call(lambda: self._serve(connection, requests))

    def closed(self, reason: str) -> None:
        self._connection = None
        self._server.clients.pop(self, None)

    def close(self, reason: str) -> None:
        """Ends the connection. Any thread."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(reason)

    def _serve(self, connection: Connection, requests: list[Request]) -> None:
        """Runs in the world's actor."""
        replies = []
        for request in requests:
            serve = self._server.serve
            if serve is None:
                return
            reply = serve(request)
            if reply is not None:
                replies.append(encode(reply))
        if replies:
            connection.send(b"".join(replies))
