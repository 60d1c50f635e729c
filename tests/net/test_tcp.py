"""What only real sockets do."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
from typing import Any

import pytest
from net.conftest import TcpRig

from pancakes.errors import PancakesError
from pancakes.mesh.address import reachable_from
from pancakes.mesh.stream import StreamTransport
from pancakes.mesh.transport import SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins


@pytest.mark.parametrize("address", ["udp://127.0.0.1:1", "tcp://::1:80", "tcp://a:65536", "tcp://a", "tcp://a:²"])
def test_what_is_no_address_of_tcp_is_said(tcp_rig, address):
    with pytest.raises(PancakesError, match="unknown transport|is no address: |has no port|has a bad port"):
        tcp_rig.transport("a").listen(address, tcp_rig.ear)


@pytest.mark.parametrize(
    ("address", "is_name"),
    [
        ("tcp://192.0.2.1:7401", False),
        ("tcp://[::1]:7401", False),
        ("tcp://localhost:7401", True),
        ("tcp://robot1.local:7401", True),
        ("no address", True),
    ],
)
def test_it_is_known_which_addresses_have_names(tcp_rig, address, is_name):
    assert tcp_rig.transport("a").may_be_named(address) is not is_name


def test_names_are_looked_up_beside_the_loop(tcp_rig):
    here, there = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    tcp_rig.transport("a").dial(address.replace("127.0.0.1", "localhost"), here)
    tcp_rig.until(lambda: there.connection)


def _has_six() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


def _link_local() -> str:
    """Returns an address of this machine that is known within one network only, with its interface; empty: none."""
    with contextlib.suppress(OSError), open("/proc/net/if_inet6", encoding="ascii") as file:
        for digits, _, _, _, _, interface in map(str.split, file):
            if digits.startswith("fe80"):
                six = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits))
                return f"{six}%{interface}"
    return ""


@pytest.mark.skipif(not _has_six(), reason="this machine has no IPv6")
def test_agents_meet_over_a_seed_that_listens_at_every_interface_of_both_kinds(tcp_rig):
    seed = tcp_rig.agent("seed", listen="tcp://[::]:0")
    port = seed.mesh.listen[0].rpartition(":")[2]
    a = tcp_rig.agent("a", [f"tcp://127.0.0.1:{port}"])
    b = tcp_rig.agent("b", [f"tcp://[::ffff:127.0.0.1]:{port}"])
    tcp_rig.until(lambda: a.knows("b", "seed") and b.knows("a", "seed"))
    assert all(link["remote"].startswith("tcp://127.0.0.1:") for link in seed.mesh.links())


@pytest.mark.skipif(not _link_local(), reason="no interface of this machine has a link-local address")
def test_an_address_of_one_network_is_known_with_its_interface(tcp_rig):
    seed = tcp_rig.agent("seed", listen="tcp://[::]:0")
    port, here = seed.mesh.listen[0].rpartition(":")[2], _link_local()
    a = tcp_rig.agent("a", [f"tcp://[{here}]:{port}"], listen="tcp://[::]:0")
    tcp_rig.until(lambda: seed.knows("a") and a.knows("seed"))
    (link,) = seed.mesh.links()
    assert link["remote"].startswith(f"tcp://[{here}]:")
    # It can be dialled at what is known of it, but means nothing to a machine that is elsewhere.
    learnt = [it["address"] for it in seed.mesh.describe()["addresses"]]
    assert learnt == [a.mesh.listen[0].replace("[::]", f"[{here}]")]
    assert reachable_from("tcp://192.0.2.1:7401", learnt) == ()
    assert reachable_from("tcp://127.0.0.1:7401", learnt) == tuple(learnt)


def test_a_name_that_does_not_exist_is_said(tcp_rig):
    here = tcp_rig.ear()
    tcp_rig.transport("a").dial("tcp://no-such-host.invalid:1", here)
    tcp_rig.until(lambda: here.closed_for)
    assert "tcp://no-such-host.invalid:1" in here.closed_for[0]


def test_a_dial_waits_five_seconds_unless_it_is_told_otherwise():
    assert StreamTransport.Settings().dial_s == 5.0


def test_a_dial_that_is_not_answered_ends_in_time(tcp_rig):
    """A listener whose queue is full answers no more."""
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen(0)
        port = deaf.getsockname()[1]
        fillers = []
        for _ in range(4):
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex(("127.0.0.1", port))
            fillers.append(filler)
        transport = SocketTransport(MonotonicClock(), "a", Plugins(), {"tcp": {"dial_s": 0.1, "insecure": True}})
        here = tcp_rig.ear()
        transport.dial(f"tcp://127.0.0.1:{port}", here)
        tcp_rig.until(lambda: here.closed_for)
        transport.close()
        for filler in fillers:
            filler.close()
    assert here.closed_for == [f"tcp://127.0.0.1:{port} did not answer within 0.1 s"]


def test_a_dial_to_whom_has_gone_again_by_the_time_it_is_seen_fails_at_once(tcp_rig, monkeypatch):
    class Left(socket.socket):
        """A socket whose other end has reset the connection since it was said to be there."""

        def getpeername(self):
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))

    here, there = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    monkeypatch.setattr(socket, "socket", Left)
    tcp_rig.transport("a").dial(address, here)
    tcp_rig.until(lambda: here.closed_for)
    assert "cannot be reached" in here.closed_for[0] and here.connection is None
    tcp_rig.until(lambda: there.closed_for)  # its socket is not left open


def test_closing_ends_the_thread_and_drops_what_was_put_off():
    before = threading.active_count()
    transport = SocketTransport(MonotonicClock(), "a", Plugins(), {"tcp": {"insecure": True}})
    assert threading.active_count() == before + 1
    ran = []
    transport.call_later(0.0, lambda: ran.append("due"))
    transport.call_later(60.0, lambda: ran.append("late"))
    transport.close()
    assert threading.active_count() == before and ran == ["due"]
    transport.call_later(0.0, lambda: ran.append("after"))
    transport.close()
    assert ran == ["due"]


def test_a_handler_that_fails_does_not_silence_the_others(tcp_rig, caplog):
    transport = tcp_rig.transport("a")
    done = threading.Event()
    transport.call_later(0.0, lambda: 1 // 0)
    transport.call_later(0.0, done.set)
    assert done.wait(10)
    assert "ZeroDivisionError" in caplog.text


def test_senders_in_many_threads_do_not_mix_their_bytes(tcp_rig):
    here, there = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    tcp_rig.transport("a").dial(address, here)
    tcp_rig.until(lambda: here.connection)

    def send(letter):
        for number in range(300):
            here.connection.send(letter + number.to_bytes(4, "big") + letter * 5000)

    threads = [threading.Thread(target=send, args=(letter,)) for letter in (b"a", b"b", b"c")]
    for thread in threads:
        thread.start()
    tcp_rig.until(lambda: len(there.data) == 3 * 300 * 5005)
    seen = {b"a": 0, b"b": 0, b"c": 0}
    for start in range(0, len(there.data), 5005):
        letter = bytes(there.data[start : start + 1])
        assert there.data[start + 1 : start + 5] == seen[letter].to_bytes(4, "big")
        assert there.data[start + 5 : start + 5005] == letter * 5000
        seen[letter] += 1


def test_a_path_is_no_place_on_a_network(tcp_rig):
    transport, ear = tcp_rig.transport("a"), tcp_rig.ear()
    with pytest.raises(PancakesError, match="cannot listen at tcp:///run/a: .* is no address of TCP"):
        transport.listen("tcp:///run/a", lambda: ear)
    transport.dial("tcp:///run/a", ear)
    tcp_rig.until(lambda: ear.closed_for)
    assert ear.closed_for == ["'tcp:///run/a' is no address of TCP: write it as tcp://host:port"]


def test_why_a_name_is_no_place_to_listen_is_said_as_the_resolver_says_it(
    tcp_rig: TcpRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*arguments: Any, **more: Any) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "no such name")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(PancakesError, match=r"^cannot listen at tcp://robot1\.local:1: no such name$"):
        tcp_rig.transport("a").listen("tcp://robot1.local:1", tcp_rig.ear)


def test_a_name_is_not_looked_up_in_the_thread_of_all_links(tcp_rig: TcpRig, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, bool]] = []
    look_up = socket.getaddrinfo

    def noted(*arguments: Any, flags: int = 0, **more: Any) -> Any:
        asked.append((threading.current_thread().name, bool(flags & socket.AI_NUMERICHOST)))
        return look_up(*arguments, **{**more, "flags": flags})

    here, there = tcp_rig.ear(), tcp_rig.ear()
    address = tcp_rig.transport("b").listen(tcp_rig.listen_at, lambda: there)
    monkeypatch.setattr(socket, "getaddrinfo", noted)
    tcp_rig.transport("a").dial(address.replace("127.0.0.1", "localhost"), here)
    tcp_rig.until(lambda: there.connection)
    assert [as_it_is for name, as_it_is in asked if name != "resolve"] == [True]
    assert ("resolve", False) in asked


def test_the_last_words_of_one_that_takes_no_more_bytes_are_heard(tcp_rig):
    with socket.create_server(("127.0.0.1", 0)) as server:
        transport, here = tcp_rig.transport("a"), tcp_rig.ear()
        transport.dial(f"tcp://127.0.0.1:{server.getsockname()[1]}", here)
        there, _ = server.accept()
        tcp_rig.until(lambda: here.connection)
        while not here.connection.send(bytes(1 << 20)):
            pass  # until some of it waits
        held, go_on = threading.Event(), threading.Event()

        def hold():
            held.set()
            go_on.wait(10)

        transport.call_later(0.0, hold)
        assert held.wait(10)
        there.send(b"last words")
        there.close()
        go_on.set()
        tcp_rig.until(lambda: here.closed_for)
        assert bytes(here.data) == b"last words"
