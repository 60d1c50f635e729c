"""Routers for tests, each a process, and transports that know them."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from net.conftest import Ear, TlsRig
from pancakes_zenoh.routed_link import RoutedLink

from pancakes.mesh.transport import SocketTransport, Transport
from pancakes.security.keys import Keys
from pancakes.util.plugins import Plugins

COMMAND = (sys.executable, "-m", "pancakes.tools.cli.main", "zenoh", "router")


class Router:
    """A router on the loopback, as `pancakes zenoh router` runs it.

    Args:
        joins: another router that it joins.
        at: where that is reached; empty: where it listens.
        more: further options of the command.
    """

    def __init__(self, joins: Router | None = None, at: str = "", more: Sequence[str] = ()) -> None:
        at = at or (joins.address if joins is not None else "")
        self._more = (*(("--connect", at) if at else ()), *more)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.address: str = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "--listen", self.address, *self._more], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert "listens at" in self.process.stdout.readline()

    def kill(self) -> None:
        self.send(signal.SIGKILL)
        self.end()

    def send(self, number: int) -> None:
        assert self.process is not None
        os.kill(self.process.pid, number)

    def end(self) -> None:
        if self.process is not None:
            assert self.process.stdout is not None
            self.process.terminate()
            self.process.wait(10)
            self.process.stdout.close()
            self.process = None


class Relay:
    """A way to a router that one agent takes, and that can be lost on the agent's side alone.

    Args:
        router: where it leads.
    """

    def __init__(self, router: Router) -> None:
        host, _, port = router.address.removeprefix("tcp/").partition(":")
        self._target = host, int(port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        self._near, _ = self._listener.accept()
        self._listener.close()  # the agent cannot come this way again
        self._far = socket.create_connection(self._target)
        back = threading.Thread(target=self._carry, args=(self._far, self._near), daemon=True)
        back.start()
        self._carry(self._near, self._far)

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)

    def lose(self) -> None:
        """Ends it for the agent; the router sees no end until `close`."""
        self._near.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._near.close()
        self._far.close()


class ZenohRig(TlsRig):
    """Transports through one router, without keys; each agent listens at a name of its own."""

    def __init__(self, directory: Path, router: Router, keyed: bool = False) -> None:
        super().__init__(directory)
        self.routers = [router.address]
        self.router = router
        self.keyed = keyed
        self.silent_s = 2.0
        self._names = 0

    @property
    def listen_at(self) -> str:  # type: ignore[override]
        self._names += 1
        return f"zenoh://agent{self._names}-{os.getpid()}:0"

    def transport(self, name: str, role: str = "agent") -> Transport:
        return super().transport(name, role) if self.keyed else self.with_keys(None)  # type: ignore[arg-type]

    def with_keys(self, folder: Path | None) -> Transport:
        keys = Keys(folder) if folder is not None else None
        settings = {"zenoh": {"insecure": keys is None, "routers": self.routers, "silent_s": self.silent_s}}
        made = SocketTransport(self.clock, keys.own.name if keys is not None else "none", Plugins(), settings, keys)
        self.transports.append(made)
        self._keys[made] = keys
        return made


def link_of(ear: Ear) -> RoutedLink:
    """Returns the link of an ear that has one."""
    assert isinstance(ear.connection, RoutedLink)
    return ear.connection
