"""Programs that connect to an agent's port and send no request: some are silent, some send a hello and stay."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from types import TracebackType

from cli.processes import PATIENCE_S

from pancakes.errors import RemoteProtocolError
from pancakes.mesh.codec import FrameReader, encode_link_message, frame, messages_from_payload
from pancakes.mesh.messages import VERSION, Hello, LinkMessage, Ping, Pong, RefuseLink, Role, Welcome


class Stranger:
    """One connection.

    Attributes:
        refusal: the sentence with which the agent refused or ended it; empty before that.
        is_up: whether the agent has accepted it.
        closed: whether the agent has closed it.
    """

    def __init__(self, address: str, hello: Hello | None) -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        self.sock = socket.create_connection((host, int(port)), PATIENCE_S)
        self.refusal = ""
        self.is_up = False
        self.closed = False
        self._reader = FrameReader()
        if hello is not None:
            self._say(hello)

    def read(self) -> None:
        """Read what has arrived, and answer pings."""
        try:
            data = self.sock.recv(65_536)
        except ConnectionError:
            data = b""
        self.closed = not data
        try:
            for payload in self._reader.feed(data):
                for message in messages_from_payload(payload):
                    if isinstance(message, RefuseLink):
                        self.refusal = message.reason
                    elif isinstance(message, Welcome):
                        self.is_up = True
                    elif isinstance(message, Ping):
                        self._say(Pong(message.token, time.monotonic()))
        except RemoteProtocolError as error:
            self.refusal = f"not understood: {error}"

    def _say(self, message: LinkMessage) -> None:
        try:
            self.sock.sendall(frame([encode_link_message(message)]))
        except OSError:
            self.closed = True


class Strangers:
    """Many of them at one address, and the thread that answers for them.

    Args:
        address: where the agent listens.
        count: how many there are.
        role: as what they introduce themselves; empty: they never say hello.
        fleet: the fleet that they claim to belong to.
    """

    def __init__(self, address: str, count: int, role: Role | None = None, fleet: str = "test") -> None:
        self._changed = threading.Condition()
        self._ending = False
        self._selector = selectors.DefaultSelector()
        self.all: list[Stranger] = []
        for number in range(count):
            name = f"stranger{number}"
            hello = Hello(VERSION, fleet, name, role, f"journal of {name}", 1) if role is not None else None
            stranger = Stranger(address, hello)
            self.all.append(stranger)
            self._selector.register(stranger.sock, selectors.EVENT_READ, stranger)
        self._thread = threading.Thread(target=self._run, name="strangers", daemon=True)
        self._thread.start()

    def __enter__(self) -> Strangers:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, traceback: TracebackType | None) -> None:
        self._ending = True
        self._thread.join(PATIENCE_S)
        for stranger in self.all:
            stranger.sock.close()
        self._selector.close()

    def up(self) -> int:
        """Returns how many the agent has taken and not closed."""
        return sum(stranger.is_up and not stranger.closed for stranger in self.all)

    def refusals(self) -> list[str]:
        """Returns the sentences with which the agent refused some."""
        return [stranger.refusal for stranger in self.all if stranger.refusal]

    def wait_until_up(self, count: int) -> None:
        """Waits until the agent has taken so many."""
        until_s = time.monotonic() + PATIENCE_S
        with self._changed:
            while self.up() < count:
                assert time.monotonic() < until_s, f"the agent took {self.up()} of {len(self.all)}: {self.refusals()}"
                self._changed.wait(0.1)

    def wait_until_refused(self, count: int) -> None:
        """Waits until the agent has refused so many."""
        until_s = time.monotonic() + PATIENCE_S
        with self._changed:
            while len(self.refusals()) < count:
                assert time.monotonic() < until_s, f"the agent refused {len(self.refusals())} of {len(self.all)}"
                self._changed.wait(0.1)

    def _run(self) -> None:
        while not self._ending:
            for key, _ in self._selector.select(0.05):
                key.data.read()
                if key.data.closed:
                    self._selector.unregister(key.fileobj)
            with self._changed:
                self._changed.notify_all()
