"""The network's thread gives turns itself while no other thread does, and another takes over where a turn holds it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel
from pancakes.mesh.event_loop import READ
from pancakes.mesh.transport import SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

PATIENCE_S = 20.0


@pytest.fixture
def kernel() -> Iterator[Kernel]:
    made = Kernel("a", seed=1)
    yield made
    made.stop()


@pytest.fixture
def transport(kernel: Kernel) -> Iterator[SocketTransport]:
    made = SocketTransport(MonotonicClock(), "a", Plugins(), {"tcp": {"insecure": True}})
    made.lend_thread(kernel.guest)
    yield made
    made.close()


class Bell:
    """Something that becomes ready to be read, and a component that is told so."""

    def __init__(self, transport: SocketTransport, component: ActorCore) -> None:

        self.reader, self._writer = socket.socketpair()
        self.reader.setblocking(False)
        self.threads: list[str] = []
        self.rung = threading.Semaphore(0)
        self.hold: threading.Event | None = None
        self._component = component
        watched = threading.Event()

        def watch() -> None:
            transport.loop.watch(self.reader, READ, self._heard)
            watched.set()

        transport.call_later(0.0, watch)
        assert watched.wait(PATIENCE_S)

    def close(self) -> None:
        self.reader.close()
        self._writer.close()

    def ring(self) -> None:
        self._writer.send(b"x")

    def _heard(self, _events: int) -> None:
        self.reader.recv(1)
        self._component.call(self._told)

    def _told(self) -> None:
        self.threads.append(threading.current_thread().name)
        hold, self.hold = self.hold, None
        self.rung.release()
        if hold is not None:
            hold.wait(PATIENCE_S)

    def wait(self) -> None:
        assert self.rung.acquire(timeout=PATIENCE_S)


@pytest.fixture
def make_bell(kernel: Kernel, transport: SocketTransport) -> Iterator[Callable[[str], Bell]]:
    made: list[Bell] = []

    def make(name: str) -> Bell:
        component = kernel.spawn(ActorCore, f"a/test/{name}")
        ready = threading.Event()
        component.call(ready.set)
        assert ready.wait(PATIENCE_S)
        made.append(Bell(transport, component))
        return made[-1]

    yield make
    transport.close()
    for bell in made:
        bell.close()


@pytest.fixture
def bell(make_bell: Callable[[str], Bell]) -> Bell:
    return make_bell("T")


def test_a_turn_is_given_without_a_hop(bell: Bell) -> None:
    for _ in range(20):
        bell.ring()
        bell.wait()
    # The first of them may still find a worker at work.
    assert bell.threads.count("net-a") >= 10


def test_a_turn_that_holds_the_thread_does_not_hold_the_network(
    bell: Bell, transport: SocketTransport, make_bell: Callable[[str], Bell]
) -> None:
    other = make_bell("Other")
    for _ in range(5):
        bell.ring()
        bell.wait()
    held = bell.hold = threading.Event()
    bell.ring()
    bell.wait()
    for _ in range(3):
        other.ring()
        other.wait()
    ran = threading.Event()
    transport.call_later(0.0, ran.set)
    assert ran.wait(PATIENCE_S), "timers run as well"
    assert not held.is_set()
    held.set()
    bell.ring()
    bell.wait()
    other.ring()
    other.wait()
    names = [thread.name for thread in threading.enumerate()]
    assert names.count("net-a") <= 2, "the one that was held has ended, or is about to"


def test_the_transport_closes_after_it_was_taken_over(bell: Bell, transport: SocketTransport) -> None:
    for _ in range(5):
        bell.ring()
        bell.wait()
    held = bell.hold = threading.Event()
    bell.ring()
    bell.wait()
    ran = threading.Event()
    transport.call_later(0.05, ran.set)
    assert ran.wait(PATIENCE_S)
    transport.close()
    held.set()
