"""What has several addresses: a dead one keeps nobody from a good one, in every place that connects."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from pancakes.mesh.sockets import by_turns, connect, pace_s
from pancakes.mesh.transport import SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

SIX, FOUR = socket.AF_INET6, socket.AF_INET


@pytest.fixture
def deaf() -> Iterator[tuple[str, int]]:
    """A place that answers nothing, as a machine does that is off: a listener whose queue is full."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        place = listener.getsockname()
        fillers = [socket.socket() for _ in range(4)]
        for filler in fillers:
            filler.setblocking(False)
            filler.connect_ex(place)
        yield place
        for filler in fillers:
            filler.close()


@pytest.fixture
def closed() -> tuple[str, int]:
    """A place that refuses connections."""
    with socket.socket() as there:
        there.bind(("127.0.0.1", 0))
        place: tuple[str, int] = there.getsockname()
        return place


@pytest.fixture
def leads_to(monkeypatch):
    """Has a name lead to places."""
    asked = socket.getaddrinfo

    def set_places(name: str, *places: Any, after_s: float = 0.0) -> None:
        def found(host: Any, port: Any, **more: Any) -> Any:
            host = host.decode() if isinstance(host, bytes) else host
            if host != name:
                return asked(host, port, **more)
            if more.get("flags", 0) & socket.AI_NUMERICHOST:
                raise socket.gaierror(socket.EAI_NONAME, "it is a name")
            threading.Event().wait(after_s)
            return [(FOUR, socket.SOCK_STREAM, 6, "", place) for place in places]

        monkeypatch.setattr(socket, "getaddrinfo", found)

    return set_places


def test_families_come_by_turns_and_that_of_the_first_place_first():
    places = [(SIX, 1), (SIX, 2), (SIX, 3), (FOUR, 4), (FOUR, 5)]
    assert by_turns(places) == [(SIX, 1), (FOUR, 4), (SIX, 2), (FOUR, 5), (SIX, 3)]
    assert by_turns([(FOUR, 1)]) == [(FOUR, 1)]


def test_the_last_place_has_half_of_the_time_at_least():
    for count in (1, 2, 5, 40):
        for within_s in (0.1, 2.0, 60.0):
            assert (count - 1) * pace_s(count, within_s) <= within_s / 2


def test_a_dead_address_of_an_agent_is_passed_by(tcp_rig, leads_to, deaf, closed):
    here, there = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    port = int(address.rpartition(":")[2])
    leads_to("robot2.lab", deaf, closed, deaf, ("127.0.0.1", port))
    began_s = time.monotonic()
    tcp_rig.transport("a").dial(f"tcp://robot2.lab:{port}", here)
    tcp_rig.until(lambda: here.connection and there.connection)
    assert time.monotonic() - began_s < 4.0, "each place has its share of the five seconds"


def test_a_slow_look_up_leaves_an_address_its_time(tcp_rig, leads_to):
    there, here = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    port = int(address.rpartition(":")[2])
    leads_to("robot2.lab", ("127.0.0.1", port), after_s=0.4)
    transport = SocketTransport(MonotonicClock(), "a", Plugins(), {"tcp": {"dial_s": 0.2, "insecure": True}})
    tcp_rig.transports.append(transport)
    transport.dial(f"tcp://robot2.lab:{port}", here)
    tcp_rig.until(lambda: here.connection)


def test_where_no_address_answers_that_is_said_in_time(tcp_rig, leads_to, deaf, closed):
    here = tcp_rig.ear()
    leads_to("robot2.lab", deaf, closed)
    transport = SocketTransport(MonotonicClock(), "a", Plugins(), {"tcp": {"dial_s": 0.3, "insecure": True}})
    tcp_rig.transports.append(transport)
    transport.dial("tcp://robot2.lab:7", here)
    tcp_rig.until(lambda: here.closed_for)
    assert here.closed_for == ["tcp://robot2.lab:7 did not answer within 0.3 s"]


def test_a_blocking_connection_passes_a_dead_address_by(leads_to, deaf, closed):
    with socket.create_server(("127.0.0.1", 0)) as good:
        leads_to("broker.lab", deaf, closed, good.getsockname())
        began_s = time.monotonic()
        with connect("broker.lab", 1883, 3.0) as sock:
            assert sock.getpeername() == good.getsockname()
            assert time.monotonic() - began_s < 2.0
            assert sock.gettimeout() == 3.0


def test_a_blocking_connection_ends_in_time_with_a_reason(leads_to, deaf, closed):
    leads_to("broker.lab", deaf)
    with pytest.raises(TimeoutError):
        connect("broker.lab", 1883, 0.2)
    leads_to("broker.lab", closed, closed)
    with pytest.raises(ConnectionRefusedError):
        connect("broker.lab", 1883, 3.0)
    with pytest.raises(socket.gaierror):
        connect("no-such-host.invalid", 1, 1.0)
