"""What zeroconf tells of announcements, some of them by programs that mean no good."""

from __future__ import annotations

import asyncio
import gc
import socket
import threading
import time
from collections.abc import Callable, Iterator
from ipaddress import ip_interface
from typing import Any

import pytest

from pancakes.mesh import dns_sd
from pancakes.mesh.announcements import SERVICE
from pancakes.mesh.dns_sd import DnsServiceDiscovery

zeroconf = pytest.importorskip("zeroconf")
dns = pytest.importorskip("zeroconf._dns")

OWN = ip_interface("127.0.0.1/8")
NEAR = ip_interface("10.0.0.5/24")
IN, PTR, SRV, TXT, A = 1, 12, 33, 16, 1
TTL_S = 4500


PATIENCE_S = 20.0


def wait_until(condition: Callable[[], object]) -> None:
    limit_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < limit_s
        time.sleep(0.005)


class Watched(DnsServiceDiscovery):
    """A discovery that the tests look into."""

    @property
    def network(self) -> Any:
        return self._zeroconf

    @property
    def asked(self) -> set[str]:
        """The labels that are asked for the rest of their announcement."""
        return set(self._asked)

    @property
    def open_questions(self) -> int:
        return len(self._questions)

    def ask(self, label: str, question: Any) -> None:
        self.network.loop.call_soon_threadsafe(self._ask, self.network, label, question)

    def goes(self, label: str) -> None:
        self._changed(self.network, SERVICE, label, zeroconf.ServiceStateChange.Removed)


def begun() -> Watched:
    try:
        discovery = Watched((OWN,))
    except OSError as error:
        pytest.skip(f"this machine has no multicast on its loopback: {error}")
    discovery.own = (NEAR,)  # what is announced in the tests is of that network
    return discovery


@pytest.fixture
def discovery() -> Iterator[Watched]:
    it = begun()
    yield it
    it.close()


def named(label: str) -> list[object]:
    return [dns.DNSPointer(SERVICE, PTR, IN, TTL_S, label)]


def rest(label: str, name: str) -> list[object]:
    texts = b"".join(bytes([len(it)]) + it for it in (f"name={name}".encode(), b"fleet=field", b"version=1"))
    return [
        dns.DNSService(label, SRV, IN, TTL_S, 0, 0, 7401, f"{name}.local."),
        dns.DNSText(label, TXT, IN, TTL_S, texts),
        dns.DNSAddress(f"{name}.local.", A, IN, TTL_S, socket.inet_aton("10.0.0.9")),
    ]


def agent(name: str) -> list[object]:
    label = f"{name}.{SERVICE}"
    return [*named(label), *rest(label, name)]


def announce(discovery: Watched, records: list[object]) -> None:
    """Gives zeroconf a packet, as if it had come from the network."""
    out = zeroconf.DNSOutgoing(0x8400)
    for it in records:
        out.add_answer_at_time(it, 0)
    network = discovery.network
    for packet in out.packets():
        network.loop.call_soon_threadsafe(
            network.record_manager.async_updates_from_response, zeroconf.DNSIncoming(packet)
        )


def names(discovery: Watched) -> list[str]:
    return [it.name for it in discovery.found()]


@pytest.mark.parametrize("label", [f"a\x01b.{SERVICE}", "robot1.example.", "robot1._other._udp.local."])
def test_a_hostile_name_ends_no_search(discovery: Watched, label: str) -> None:
    announce(discovery, named(label))
    announce(discovery, agent("robot2"))
    wait_until(lambda: names(discovery) == ["robot2"])
    assert discovery.ignored == 1


def test_no_thread_outlives_a_discovery() -> None:
    before = set(threading.enumerate())
    begun().close()
    assert set(threading.enumerate()) <= before


class Question:
    """A service that is asked for the rest of its announcement, and answers when it is let."""

    port = 7401
    properties = {b"name": b"robot2", b"fleet": b"field"}

    def __init__(self) -> None:
        self.may_answer = threading.Event()

    def parsed_addresses(self) -> list[str]:
        return ["10.0.0.9"]

    async def async_request(self, network: object, timeout_ms: float) -> bool:
        while not self.may_answer.is_set():
            await asyncio.sleep(0)
        return True


@pytest.mark.parametrize("has_gone", [False, True])
def test_what_goes_while_it_is_asked_is_not_found(discovery: Watched, has_gone: bool) -> None:
    label, question = f"robot2.{SERVICE}", Question()
    discovery.ask(label, question)
    wait_until(lambda: label in discovery.asked)
    if has_gone:
        discovery.goes(label)
    question.may_answer.set()
    wait_until(lambda: not discovery.open_questions and label not in discovery.asked)
    wait_until(lambda: has_gone or names(discovery) == ["robot2"])
    assert (names(discovery) == []) is has_gone, "nothing would ever take it back"


def test_a_question_that_is_open_at_the_end_says_nothing_on_the_terminal(caplog: pytest.LogCaptureFixture) -> None:
    discovery = begun()
    announce(discovery, named(f"robot2.{SERVICE}"))
    wait_until(lambda: discovery.open_questions)
    discovery.close()
    gc.collect()
    assert caplog.text == ""


def test_what_found_no_room_is_found_later(discovery: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dns_sd, "MOST_FOUND", 0)
    announce(discovery, agent("robot2"))
    wait_until(lambda: discovery.ignored >= 1)
    discovery.look_again()
    assert names(discovery) == []
    monkeypatch.undo()
    discovery.look_again()
    wait_until(lambda: names(discovery) == ["robot2"])


def test_what_could_not_be_asked_is_asked_later(discovery: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    label = f"robot2.{SERVICE}"
    monkeypatch.setattr(dns_sd, "MOST_ASKED", 0)
    announce(discovery, named(label))
    wait_until(lambda: discovery.ignored == 1)
    monkeypatch.undo()
    discovery.look_again()
    wait_until(lambda: label in discovery.asked)
