"""The devices' end of the hardware bus: one connection for all simulated devices of an agent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

from pancakes.bodies.sim.bus import Attach, RawReading, Refused, Replied, ReplyReader, Request, encode
from pancakes.errors import RemoteProtocolError
from pancakes.mesh.net.transport import Connection, ConnectionHandler, Scheduled, Transport

_FIRST_RETRY_S = 0.1
_LONGEST_RETRY_S = 1.0
_WARN_AFTER_S = 5.0


@dataclass(frozen=True, slots=True)
class Attachment:
    """A device that uses a body, and what becomes of the replies to it.

    The functions are called in the transport's thread.

    Attributes:
        attach: says which device uses which body.
        reading: takes a reading.
        refused: takes the reason why a request was refused.
        lost: told that the world is gone: what was asked for will not come.
    """

    attach: Attach
    reading: Callable[[RawReading], None]
    refused: Callable[[str], None]
    lost: Callable[[], None]


class BusClient:
    """Keeps a connection to a simulated world, and dials again where there is none.

    `attach`, `detach`, `send` and `close` may be called from any thread.

    Args:
        transport: how to reach the world.
        address: where its hardware bus listens.
        log: takes (level, text), from any thread.
    """

    def __init__(self, transport: Transport, address: str, log: Callable[[str, str], None]) -> None:
        self._transport = transport
        self._address = address
        self._log = log
        self._lock = Lock()  # guards the two below; never kept over a call
        self._attachments: dict[str, Attachment] = {}
        self._closed = False
        self._connection: Connection | None = None
        self._reached = False  # whether the world has answered on this connection
        self._retry: Scheduled | None = None
        self._retry_s = _FIRST_RETRY_S
        self._waited_s = 0.0
        self._warned = False
        self._transport.dial(address, _DialedConnection(self))

    def attach(self, attachment: Attachment) -> None:
        """Lets a device use a body, from now on and after each reconnection."""
        with self._lock:
            self._attachments = {**self._attachments, attachment.attach.device: attachment}
        self.send(attachment.attach)

    def detach(self, device: str) -> None:
        """Forgets a device: it gets no more replies."""
        with self._lock:
            self._attachments = {name: one for name, one in self._attachments.items() if name != device}

    def send(self, request: Request) -> bool:
        """Sends a request; returns whether there is a connection for it. Without one it is dropped."""
        connection = self._connection
        if connection is None:
            return False
        connection.send(encode(request))
        return True

    def close(self) -> None:
        """Closes the connection and dials no more."""
        with self._lock:
            self._closed = True
        retry, connection = self._retry, self._connection
        self._connection = None
        if retry is not None:
            retry.cancel()
        if connection is not None:
            connection.close("the devices are closed")

    def opened(self, connection: Connection) -> None:
        """A connection stands; called in the transport's thread, as are the two below."""
        if self._closed:
            connection.close("the devices are closed")
            return
        self._connection = connection
        for attachment in self._attachments.values():
            self.send(attachment.attach)

    def replied(self, reply: Replied) -> None:
        """The world has answered."""
        if not self._reached:
            self._reached = True
            self._retry_s, self._waited_s, self._warned = _FIRST_RETRY_S, 0.0, False
            self._log("info", f"reached the world at {self._address}")
        attachment = self._attachments.get(reply.device)
        if attachment is None:
            return  # its device was closed meanwhile
        if isinstance(reply, RawReading):
            attachment.reading(reply)
        elif isinstance(reply, Refused):
            attachment.refused(reply.reason)

    def lost(self, reason: str) -> None:
        """The connection is gone, or could not be made."""
        was_reached, self._reached = self._reached, False
        self._connection = None
        if self._closed:
            return
        if was_reached:
            self._log("error", f"the world at {self._address} is gone ({reason})")
            for attachment in self._attachments.values():
                attachment.lost()
        elif self._waited_s >= _WARN_AFTER_S and not self._warned:
            self._warned = True
            self._log("warning", f"the world at {self._address} does not answer ({reason}); trying on")
        delay_s = self._retry_s
        self._waited_s += delay_s
        self._retry_s = min(2.0 * delay_s, _LONGEST_RETRY_S)
        self._retry = self._transport.call_later(delay_s, self._dial)

    def _dial(self) -> None:
        if not self._closed:
            self._transport.dial(self._address, _DialedConnection(self))


class _DialedConnection(ConnectionHandler):
    """One attempt at a connection, and the connection if it stands."""

    def __init__(self, client: BusClient) -> None:
        self._client = client
        self._reader = ReplyReader()
        self._connection: Connection | None = None

    def opened(self, connection: Connection) -> None:
        self._connection = connection
        self._client.opened(connection)

    def received(self, data: bytes) -> None:
        try:
            replies = self._reader.feed(data)
        except RemoteProtocolError as error:
            if self._connection is not None:
                self._connection.close(str(error))
            return
        for reply in replies:
            self._client.replied(reply)

    def closed(self, reason: str) -> None:
        self._client.lost(reason)
