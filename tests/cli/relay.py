"""A relay between two agents that knows nothing of what they say: it delays bytes, or cuts the link."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator


class Relay:
    """Forward connections to an agent that listens elsewhere.

    Args:
        target: the address of that agent, `tcp://HOST:PORT`.

    Attributes:
        address: where to dial the relay.
        answered: called with each piece of bytes from the agent, before it is forwarded. It returns whether the piece
            may pass; if not, the link is cut.
    """

    def __init__(self, target: str) -> None:
        self._target = target
        self._server = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self.answered: Callable[[bytes], bool] = lambda data: True
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        for end in (self._server, *self._ends):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                ours, _ = self._server.accept()
                host, _, port = self._target.removeprefix("tcp://").rpartition(":")
                try:
                    theirs = socket.create_connection((host, int(port)), 2.0)
                except OSError:
                    ours.close()
                    continue
                theirs.settimeout(None)
                for end in (ours, theirs):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._ends += [ours, theirs]
                for run in (self._pass_on, self._forward):
                    threading.Thread(target=run, args=(ours, theirs), daemon=True).start()

    def _pass_on(self, ours: socket.socket, theirs: socket.socket) -> None:
        for data in _pieces(ours):
            with contextlib.suppress(OSError):
                theirs.sendall(data)
        _end(theirs)

    def _forward(self, ours: socket.socket, theirs: socket.socket) -> None:
        for data in _pieces(theirs):
            if not self.answered(data):
                break
            with contextlib.suppress(OSError):
                ours.sendall(data)
        _end(ours)
        _end(theirs)


def _pieces(end: socket.socket) -> Iterator[bytes]:
    with contextlib.suppress(OSError):
        while data := end.recv(1 << 16):
            yield data


def _end(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
