"""Lines with tiny nodes: a serial port, a UDP port, a serial port at the far end of a TCP connection.

A line recovers by itself: if it is missing or lost, it is tried again until it is there. It reports that once.
"""

from __future__ import annotations

import os
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final, Protocol

from pancakes.mesh.transport import Connection, ConnectionHandler, Scheduled, Transport

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 5.0
"""The pause, in host time, before a missing line is tried again."""

Reply = Callable[[bytes], object]
"""Sends bytes back to the node that has just sent. They are lost if the line is gone."""


class Listener(Protocol):
    """Take what comes on a line. Called in the line's thread."""

    def found(self) -> None:
        """The line is there."""
        ...

    def heard(self, data: bytes, reply: Reply, whole: bool) -> None:
        """Bytes have come in; `whole`: they are a datagram, which shares no frame with the next."""
        ...

    def lost(self, reason: str) -> None:
        """The line is missing or lost; also called after each failed attempt."""
        ...


class Line(ABC):
    """One line. `open` and `close` are called once each, and do not wait."""

    @abstractmethod
    def open(self, listener: Listener) -> None:
        """Begin to listen."""

    @abstractmethod
    def close(self) -> None:
        """Stop listening. Bytes on their way may still be delivered."""


class _ThreadLine(Line):
    """A line with a thread that waits for bytes."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._ended = threading.Event()
        self._pause_s = FIRST_PAUSE_S

    def open(self, listener: Listener) -> None:
        threading.Thread(target=self._run, args=(listener,), name=f"line-{self._name}", daemon=True).start()

    def close(self) -> None:
        self._ended.set()

    def _run(self, listener: Listener) -> None:
        while not self._ended.is_set():
            try:
                self._attend(listener)
            except OSError as error:  # pyserial's errors are of this kind too
                if self._ended.is_set():
                    return
                listener.lost(_sentence(error))
            self._ended.wait(self._pause_s)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)

    @abstractmethod
    def _attend(self, listener: Listener) -> None:
        """Open the line and listen until it is closed or breaks. Raises OSError."""


class SerialLine(_ThreadLine):
    """A serial port of this computer.

    Args:
        port: its file, such as `/dev/ttyUSB0`.
        baud: bits a second.
    """

    def __init__(self, port: str, baud: int) -> None:
        super().__init__(port)
        self._port = port
        self._baud = baud
        self._cancel: Callable[[], None] = lambda: None

    def close(self) -> None:
        super().close()
        self._cancel()

    def _attend(self, listener: Listener) -> None:
        import serial

        with serial.Serial(self._port, self._baud, write_timeout=0, exclusive=True) as port:
            self._cancel = port.cancel_read
            port.reset_input_buffer()  # readings from before this are old
            listener.found()

            def reply(data: bytes) -> None:
                if port.is_open:
                    port.write(data)

            while not self._ended.is_set():
                try:
                    data = port.read(max(1, port.in_waiting))
                except OSError:  # pyserial says this in many ways
                    raise OSError("nothing is at its other end any more") from None
                if data:
                    self._pause_s = FIRST_PAUSE_S
                    listener.heard(data, reply, False)


class UdpLine(_ThreadLine):
    """A UDP port of this computer, to which any number of tiny nodes send.

    Args:
        host: the address to listen at.
        port: the port.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__(f"{host}:{port}")
        self._at = (host, port)
        self.address = self._at
        """Where it really listens, once it does: port 0 takes a free one."""

    def _attend(self, listener: Listener) -> None:
        family = socket.AF_INET6 if ":" in self._at[0] else socket.AF_INET
        with socket.socket(family, socket.SOCK_DGRAM) as port:
            port.bind(self._at)
            port.settimeout(0.2)  # a socket cannot be closed under a thread that waits for it
            self.address = port.getsockname()[:2]
            listener.found()
            while not self._ended.is_set():
                try:
                    data, sender = port.recvfrom(2048)
                except TimeoutError:
                    continue
                listener.heard(data, lambda answer, sender=sender: _send(port, answer, sender), True)  # type: ignore[misc]


class TcpLine(Line):
    """A serial port at the far end of a connection, as a terminal server or `ser2net` offers it.

    In virtual time the network in memory is that connection.

    Args:
        transport: how to reach it.
        address: where it is, such as `tcp://192.168.1.20:4001`.
    """

    def __init__(self, transport: Transport, address: str) -> None:
        self._transport = transport
        self._address = address
        self._closed = False
        self._pause_s = FIRST_PAUSE_S
        self._retry: Scheduled | None = None
        self._connection: Connection | None = None

    def open(self, listener: Listener) -> None:
        self._transport.dial(self._address, _Call(self, listener))

    def close(self) -> None:
        self._closed = True
        retry, connection = self._retry, self._connection
        if retry is not None:
            retry.cancel()
        if connection is not None:
            connection.close("the line is closed")

    def stands(self, connection: Connection) -> bool:
        """A connection stands; returns whether it is wanted. In the transport's thread, as the next."""
        if self._closed:
            connection.close("the line is closed")
            return False
        self._connection = connection
        return True

    def speaks(self) -> None:
        """Bytes have come, so it is worth the while to dial soon where the connection breaks."""
        self._pause_s = FIRST_PAUSE_S

    def ended(self, listener: Listener) -> bool:
        """A connection is gone, or never stood; returns whether the line is still wanted."""
        self._connection = None
        if self._closed:
            return False
        self._retry = self._transport.call_later(self._pause_s, lambda: self.open(listener))
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        return True


class _Call(ConnectionHandler):
    """One attempt at a connection, and the connection if it stands."""

    def __init__(self, line: TcpLine, listener: Listener) -> None:
        self._line = line
        self._listener = listener
        self._connection: Connection | None = None

    def opened(self, connection: Connection) -> None:
        if self._line.stands(connection):
            self._connection = connection
            self._listener.found()

    def received(self, data: bytes) -> None:
        connection = self._connection
        if connection is not None:
            self._line.speaks()
            self._listener.heard(data, connection.send, False)

    def closed(self, reason: str) -> None:
        self._connection = None
        if self._line.ended(self._listener):
            self._listener.lost(reason)


def _send(port: socket.socket, data: bytes, to: tuple[str, int]) -> None:
    if port.fileno() >= 0:
        port.sendto(data, to)


def _sentence(error: OSError) -> str:
    """What went wrong, without the numbers and brackets that libraries add."""
    if error.errno is not None:
        return os.strerror(error.errno)
    return str(error)
