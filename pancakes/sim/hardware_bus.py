"""The hardware bus: how a simulated robot's devices talk to the simulated world. Messages, client and server.

It plays the wires inside a robot: it has connections of its own, is not affected by faults of the mesh, and costs
no battery. Requests go to the world and replies come back, each in a frame as on the mesh. `BusClient` is the devices'
end, one connection for all simulated devices of an agent; `BusServer` is the world's end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from threading import Lock
from typing import Any, Final, Generic, TypeAlias, TypeVar

import msgspec

from pancakes.devices.validation import fault_of_command
from pancakes.errors import RemoteProtocolError
from pancakes.mesh.codec import FrameReader, frame
from pancakes.mesh.transport import Connection, ConnectionHandler, Scheduled, Transport
from pancakes.packet import body_class
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed


class Attach(msgspec.Struct, tag_field="is", tag="attach", array_like=True, frozen=True):
    """A request of a device to use a body.

    Attributes:
        body: the body's name.
        device: the device's name, which all replies to it carry.
        type: the device's type.
        model: the kind of robot that a drive believes it drives; empty for sensors.
    """

    body: str
    device: str
    type: str
    model: str = ""


class Drive(msgspec.Struct, tag_field="is", tag="drive", array_like=True, frozen=True):
    """Run the wheels.

    Attributes:
        body: the robot's name.
        device: the device's name.
        left_mps: speed of the left wheel.
        right_mps: speed of the right wheel.
        ttl_s: its time to live, in mission seconds; then the wheels stop.
        source: address of the task that commands it.
    """

    body: str
    device: str
    left_mps: float
    right_mps: float
    ttl_s: float
    source: str


class Command(msgspec.Struct, tag_field="is", tag="command", array_like=True, frozen=True):
    """A command to an actuator other than wheels.

    Attributes:
        body: the body's name.
        device: the device's name.
        type: the device's type, which is the packet type of the command.
        value: the command, a body of that packet type.
        ttl_s: its time to live, in mission seconds; then the actuator goes to its safe hold.
        source: address of the task that commands it.
    """

    body: str
    device: str
    type: str
    value: Any
    ttl_s: float
    source: str


class RawCommand(msgspec.Struct, tag_field="is", tag="command", array_like=True, frozen=True):
    """A `Command` as it arrives: its value is still encoded, so that it is decoded directly to its class."""

    body: str
    device: str
    type: str
    value: msgspec.Raw
    ttl_s: float
    source: str

    def command(self) -> Any:
        """Return the command, a body of its packet type.

        Raises:
            RemoteProtocolError: its type is unknown here, or the value does not fit it.
        """
        cls = body_class(self.type)
        if cls is None:
            raise RemoteProtocolError(f"the packet type {self.type!r} is unknown here: install what registers it")
        try:
            command = _decoder(cls)(self.value)
        except MALFORMED as error:
            raise RemoteProtocolError(f"a command of the type {self.type!r} has a bad body: {error}") from None
        fault = fault_of_command(command) if math.isfinite(self.ttl_s) else f"ttl_s is {self.ttl_s:g}"
        if fault:
            raise RemoteProtocolError(f"a command of the type {self.type!r} cannot be carried out: {fault}")
        return command


class Halt(msgspec.Struct, tag_field="is", tag="halt", array_like=True, frozen=True):
    """Bring an actuator to its safe hold at once: wheels stop."""

    body: str
    device: str


class Sample(msgspec.Struct, tag_field="is", tag="sample", array_like=True, frozen=True):
    """Ask a sensor for a reading.

    Attributes:
        body: the body's name.
        device: the device's name.
        type: the device's type.
        packets_sent: how many mission packets the body's agent has sent so far, reported by the device that
            measures the battery.
        listening: whether the agent's Network Service is awake, reported by the same device.
    """

    body: str
    device: str
    type: str
    packets_sent: int | None = None
    listening: bool | None = None


class Attached(msgspec.Struct, tag_field="is", tag="attached", array_like=True, frozen=True):
    """A device may use the body that it asked for."""

    device: str


class Reading(msgspec.Struct, tag_field="is", tag="reading", array_like=True, frozen=True):
    """A reading of a sensor: the body of a packet of the device's type."""

    device: str
    type: str
    value: Any


class RawReading(msgspec.Struct, tag_field="is", tag="reading", array_like=True, frozen=True):
    """A `Reading` as it arrives: its value is still encoded, so that it is decoded directly to its class."""

    device: str
    type: str
    value: msgspec.Raw

    def body(self) -> Any:
        """Return the body of the packet; plain values if its type is unknown here.

        Raises:
            RemoteProtocolError: the value does not fit the type.
        """
        try:
            return _decoder(body_class(self.type) or Any)(self.value)
        except MALFORMED as error:
            raise RemoteProtocolError(f"a packet of the type {self.type!r} has a bad body: {error}") from None


class Refused(msgspec.Struct, tag_field="is", tag="refused", array_like=True, frozen=True):
    """The refusal of a request, and why."""

    device: str
    reason: str


Request: TypeAlias = Attach | Command | Drive | Halt | Sample
Requested: TypeAlias = Attach | RawCommand | Drive | Halt | Sample
Reply: TypeAlias = Attached | Reading | Refused
Replied: TypeAlias = Attached | RawReading | Refused

_REQUESTS: Final[Callable[[Any], list[Requested]]] = codecs.decoder(list[Requested])
_REPLIES: Final[Callable[[Any], list[Replied]]] = codecs.decoder(list[Replied])
_Message = TypeVar("_Message")


@cache
def _decoder(cls: Any) -> Callable[[Any], Any]:
    return codecs.decoder(cls)


def encode(message: Request | Reply) -> bytes:
    """Return a message as a frame."""
    return frame([codecs.encode(message)])


class BusReader(Generic[_Message]):
    """Decode messages from the other end; see `RequestReader` and `ReplyReader`.

    Args:
        decode: decodes the messages of a frame.
        called: the name of a message, for errors.
    """

    def __init__(self, decode: Callable[[Any], list[_Message]], called: str) -> None:
        self._frames = FrameReader()
        self._decode = decode
        self._called = called

    def feed(self, data: bytes) -> list[_Message]:
        """Take bytes, and return the messages that are now complete.

        Raises:
            RemoteProtocolError: the bytes are not such messages.
        """
        try:
            return [message for payload in self._frames.feed(data) for message in self._decode(payload)]
        except MALFORMED as error:
            raise RemoteProtocolError(f"that is not a {self._called}: {why_malformed(error)}") from None


RequestReader: Final = partial(BusReader[Requested], _REQUESTS, "request to a simulated world")
"""Make requests of the bytes that come from one client."""
ReplyReader: Final = partial(BusReader[Replied], _REPLIES, "reply of a simulated world")
"""Make replies of the bytes that come from a world."""


_FIRST_RETRY_S = 0.1
_LONGEST_RETRY_S = 1.0
_WARN_AFTER_S = 5.0


@dataclass(frozen=True, slots=True)
class Attachment:
    """A device that uses a body, and the callbacks for its replies.

    The functions are called in the transport's thread.

    Attributes:
        attach: the request with the device and the body.
        reading: takes a reading.
        refused: takes the reason why a request was refused.
        lost: called when the world is gone: replies that are due will not come.
    """

    attach: Attach
    reading: Callable[[RawReading], None]
    refused: Callable[[str], None]
    lost: Callable[[], None]


class BusClient:
    """Keep a connection to a simulated world, and dial again if it is lost.

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
        self._lock = Lock()  # guards the two below; never held during a call
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
        """Let a device use a body, from now on and after each reconnection."""
        with self._lock:
            self._attachments = {**self._attachments, attachment.attach.device: attachment}
        self.send(attachment.attach)

    def detach(self, device: str) -> None:
        """Forget a device: it gets no more replies."""
        with self._lock:
            self._attachments = {name: one for name, one in self._attachments.items() if name != device}

    def send(self, request: Request) -> bool:
        """Send a request; return whether there is a connection for it. Without one it is dropped."""
        connection = self._connection
        if connection is None:
            return False
        connection.send(encode(request))
        return True

    def close(self) -> None:
        """Close the connection and stop dialling."""
        with self._lock:
            self._closed = True
        retry, connection = self._retry, self._connection
        self._connection = None
        if retry is not None:
            retry.cancel()
        if connection is not None:
            connection.close("the devices are closed")

    def opened(self, connection: Connection) -> None:
        """Take a connection; called in the transport's thread, as are the two below."""
        if self._closed:
            connection.close("the devices are closed")
            return
        self._connection = connection
        for attachment in self._attachments.values():
            self.send(attachment.attach)

    def replied(self, reply: Replied) -> None:
        """Take the world's replies."""
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
        """Handle a lost or failed connection."""
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
            self._log("warning", f"the world at {self._address} does not answer ({reason}); still trying")
        delay_s = self._retry_s
        self._waited_s += delay_s
        self._retry_s = min(2.0 * delay_s, _LONGEST_RETRY_S)
        self._retry = self._transport.call_later(delay_s, self._dial)

    def _dial(self) -> None:
        if not self._closed:
            self._transport.dial(self._address, _DialedConnection(self))


class _DialedConnection(ConnectionHandler):
    """One attempt at a connection, and the connection if it succeeds."""

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


Serve = Callable[[Requested], Reply | None]
Call = Callable[[Callable[[], None]], None]
Log = Callable[[str, str], None]


class BusServer:
    """Take requests from simulated devices and pass them to the actor that owns the world.

    Args:
        transport: where it listens.
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
        """Take connections at `address` from now on; return the address with the actual port.

        Raises:
            PancakesError: the address is in use, or is no address.
        """
        self._address = self._transport.listen(address, lambda: _BusConnection(self))
        return self._address

    def close(self) -> None:
        """Stop answering, free the address, and close the connections, so that the devices notice.

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
        """End the connection. Any thread."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(reason)

    def _serve(self, connection: Connection, requests: list[Requested]) -> None:
        """Run in the world's actor."""
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
