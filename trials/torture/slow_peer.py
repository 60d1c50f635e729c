"""A peer that speaks the protocol but hardly reads, on a raw socket, so that it can be arbitrarily slow."""

from __future__ import annotations

import select
import socket
import threading
import time

from pancakes.mesh.codec import frame
from pancakes.mesh.link import Action, Link, LinkTimes, Over, SendMessage, Up
from pancakes.mesh.messages import Identity

LOOK_S = 0.02


class SlowPeer:
    """Dials an agent, becomes its neighbour, sends heartbeats in time, and reads at a set speed.

    Args:
        address: the address of the agent.
        name: its own name; greater than the agent's, so that the agent accepts its link.
        fleet: its fleet.

    Attributes:
        bytes_per_s: how fast it reads; 0: not at all; infinity: everything at once.
        is_up: set once it is connected.
        is_over: set once either side has ended the link.
    """

    def __init__(self, address: str, name: str = "zz-slow", fleet: str = "load") -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        self.bytes_per_s = float("inf")
        self.is_up = threading.Event()
        self.is_over = threading.Event()
        self.reason = ""
        self._sock = socket.socket()
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # so it buffers little
        self._sock.settimeout(5.0)
        self._sock.connect((host, int(port)))
        self._link = Link(
            Identity(name, f"journal-of-{name}", 1, fleet, "agent").hello(), LinkTimes(), time.monotonic()
        )
        self._ended = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the socket without a goodbye."""
        self._ended = True
        self._thread.join()

    def _run(self) -> None:
        try:
            self._act(self._link.open(time.monotonic()))
            owed, before_s = 0.0, time.monotonic()
            while not self._ended and not self.is_over.is_set():
                now_s = time.monotonic()
                owed, before_s = min(65_536.0, owed + self.bytes_per_s * (now_s - before_s)), now_s
                # A closed socket is noticed only by reading to its end, or by writing.
                if owed >= 1 and select.select([self._sock], [], [], LOOK_S)[0]:
                    data = self._sock.recv(int(owed))
                    if not data:
                        raise ConnectionError("closed by the agent")
                    owed -= len(data)
                    self._act(self._link.receive(data, now_s))
                elif owed < 1:
                    select.select([], [], [], LOOK_S)
                if self._link.peer is not None and self.bytes_per_s < 2:
                    self._link.receive(b"", now_s)  # do not count the agent as silent
                self._act(self._link.tick(now_s))
        except OSError as error:
            self.reason = self.reason or str(error)
        finally:
            self._sock.close()
            self.is_over.set()

    def _act(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case SendMessage(message):
                    self._sock.sendall(frame([message]))
                case Up():
                    self.is_up.set()
                case Over(reason):
                    self.reason = reason
                    self.is_over.set()
