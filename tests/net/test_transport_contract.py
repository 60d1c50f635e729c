"""What every transport promises, on real sockets and in virtual time alike."""

from __future__ import annotations

import contextlib
import socket
import threading

import pytest
from net.conftest import RIGS, LocalRig, TcpRig

from pancakes.errors import PancakesError


# The underscore keeps it out of `import *`: transports of plugins run these tests on rigs of their own.
@pytest.fixture(name="rig", params=list(RIGS))
def _every_rig(request, tmp_path):
    with contextlib.closing(RIGS[request.param](tmp_path)) as made:
        yield made


def joined(rig, ear):
    """Two transports with a connection between them: (dialling ear, accepting ear)."""
    here, there = ear(), ear()
    address = rig.transport("b").listen(rig.listen_at, lambda: there)
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.connection and there.connection)
    return here, there


def with_late_reader(rig):
    """Two transports with a connection between them, whose accepting ear hears once a gate is open."""
    (here, there), gate = joined(rig, rig.ear), threading.Event()
    swallow = there.received
    there.received = lambda data: (gate.wait(10), swallow(data))
    return here, there, gate


def test_bytes_arrive_both_ways_in_order(rig, ear):
    here, there = joined(rig, ear)
    for number in range(200):
        here.connection.send(bytes([number]))
        there.connection.send(bytes([255 - number]))
    rig.until(lambda: len(here.data) == 200 and len(there.data) == 200)
    assert there.data == bytes(range(200))
    assert here.data == bytes(range(255, 55, -1))


def test_much_at_once_arrives_whole_and_in_order(rig, ear):
    here, there = joined(rig, ear)
    chunks = [bytes([number % 251]) * 100_000 for number in range(200)]
    for chunk in chunks:
        here.connection.send(chunk)
    rig.until(lambda: len(there.data) == 20_000_000)
    assert there.data == b"".join(chunks)
    assert here.connection.unsent() == 0


def test_the_real_port_is_told(rig, ear):
    wanted = rig.listen_at if rig.listen_at.endswith(":0") else "tcp://127.0.0.1:0"
    address = rig.transport("a").listen(wanted, lambda: ear())
    assert address.startswith(wanted.removesuffix("0")) and not address.endswith(":0")


def test_a_port_in_use_is_an_error_that_names_it(rig, ear):
    address = rig.transport("a").listen(rig.listen_at, lambda: ear())
    with pytest.raises(PancakesError, match=f"{address}.*in use"):
        rig.transport("b").listen(address, lambda: ear())


def test_an_address_at_which_nothing_listens_any_more_is_free_at_once(rig, ear):
    first, second, here = ear(), ear(), ear()
    transport = rig.transport("b")
    address = transport.listen(rig.listen_at, lambda: first)
    for _ in range(3):
        transport.stop_listening(address)
        assert transport.listen(address, lambda: second) == address
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.connection and second.connection)
    assert first.connection is None
    transport.stop_listening(address)
    second.connection.send(b"it stays")
    rig.until(lambda: here.data == b"it stays")
    refused = ear()
    rig.transport("a").dial(address, refused)
    rig.until(lambda: refused.closed_for)
    assert refused.closed_for == [f"{address} cannot be reached: connection refused"]


def test_listen_at_what_is_no_address_is_refused(rig, ear):
    transport = rig.transport("a")
    for address in ("", "7401", "tcp://", "tcp://host", "tcp://:1", "tcp://127.0.0.1:x"):
        with pytest.raises(PancakesError, match="cannot listen at"):
            pytest.fail(f"{address!r} is listened at: {transport.listen(address, ear)}")


@pytest.mark.parametrize("nobody", [True, False])
def test_a_dial_that_fails_is_told_once(rig, ear, nobody):
    address = "nonsense"
    if nobody:
        # A port that was just given back: no other program is likely to have taken it.
        closed = rig.transport("c")
        address = closed.listen(rig.listen_at, lambda: ear())
        closed.close()
    here = ear()
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.closed_for)
    assert here.connection is None
    assert len(here.closed_for) == 1 and address in here.closed_for[0]
    if nobody:
        assert here.closed_for == [f"{address} cannot be reached: connection refused"]


def test_closing_is_told_once_to_each_side(rig, ear):
    here, there = joined(rig, ear)
    here.connection.close("enough")
    here.connection.close("again")
    rig.until(lambda: here.closed_for and there.closed_for)
    assert here.closed_for == ["enough"]
    assert there.closed_for == ["the other side closed the connection"]


def test_one_that_has_closed_hears_nothing_more(rig, ear):
    here, there = joined(rig, ear)
    here.connection.close("enough")
    there.connection.send(b"too late")
    rig.until(lambda: here.closed_for and there.closed_for)
    assert here.data == b""


def test_last_words_arrive_even_where_the_other_side_talks_on(rig, ear):
    here, there = joined(rig, ear)
    there.connection.send(b"x" * 100_000)
    here.connection.send(b"farewell")
    here.connection.close("enough")
    rig.until(lambda: there.closed_for)
    assert there.data == b"farewell"


def test_what_was_sent_before_closing_arrives(rig, ear):
    here, there = joined(rig, ear)
    here.connection.send(b"x" * 20_000_000)
    here.connection.close("enough")
    rig.until(lambda: there.closed_for)
    assert len(there.data) == 20_000_000


def test_nothing_is_sent_after_closing(rig, ear):
    here, there = joined(rig, ear)
    here.connection.close()
    here.connection.send(b"too late")
    rig.until(lambda: here.closed_for and there.closed_for)
    assert there.data == b""
    assert here.connection.unsent() == here.connection.send(b"too late") == 0


def test_closing_a_transport_closes_all_that_is_open(rig, ear):
    here, there = ear(), ear()
    a, b = rig.transport("a"), rig.transport("b")
    a.dial(b.listen(rig.listen_at, lambda: there), here)
    rig.until(lambda: here.connection and there.connection)
    a.close()
    rig.until(lambda: here.closed_for and there.closed_for)
    assert here.closed_for == ["the transport was closed"]


def test_what_was_put_off_runs_in_order_and_can_be_cancelled(rig):
    transport = rig.transport("a")
    seen: list[str] = []
    transport.call_later(0.05, lambda: seen.append("late"))
    transport.call_later(0.0, lambda: seen.append("first"))
    transport.call_later(0.0, lambda: seen.append("second"))
    transport.call_later(0.02, lambda: seen.append("never")).cancel()
    rig.until(lambda: "late" in seen)
    assert seen == ["first", "second", "late"]


def test_all_callbacks_come_from_one_thread(rig, ear):
    here, _ = joined(rig, ear)
    here.connection.close()
    rig.until(lambda: here.closed_for)
    assert len({*here.threads}) == 1
    assert (threading.get_ident() in here.threads) == rig.virtual


def test_callbacks_never_run_inside_of_a_call(rig, ear):
    """Else a caller that holds a lock would meet itself."""
    here, there = joined(rig, ear)
    order: list[str] = []
    here.closed = lambda reason: order.append("closed")

    def close() -> None:
        here.connection.close()
        order.append("call returned")

    here.received = lambda data: close()
    there.connection.send(b"close it from the transport's own thread")
    rig.until(lambda: "closed" in order)
    assert order == ["call returned", "closed"]


@pytest.mark.parametrize("kind", [TcpRig, LocalRig])
def test_small_sends_to_a_reader_that_begins_late_arrive_whole(kind):
    """A socket that has no room for a send refuses it; the connection stands all the same."""
    with contextlib.closing(kind()) as rig:
        here, there, gate = with_late_reader(rig)
        sends = 1
        while here.connection.send(bytes(1000)) == 0 and not here.closed_for:
            sends += 1
        gate.set()
        rig.until(lambda: len(there.data) == 1000 * sends or here.closed_for)
        assert not here.closed_for
        rig.until(lambda: here.connection.unsent() == 0)


@pytest.mark.parametrize("kind", [TcpRig, LocalRig])
def test_send_over_a_broken_connection_closes_it(kind):
    with contextlib.closing(kind()) as rig:
        here, _, gate = with_late_reader(rig)
        here.connection.send(b"the other side reads this, and no more until the gate is open")
        here.connection._sock.shutdown(socket.SHUT_WR)  # noqa: SLF001 - no peer can break its sending side only
        assert here.connection.send(b"lost") == 0
        rig.until(lambda: here.closed_for)
        gate.set()
        assert "broke: broken pipe" in here.closed_for[0].lower()


def test_a_connection_says_when_it_has_room_again(tcp_rig):
    """Over TCP: more than the kernel's buffers hold, and a reader that begins late."""
    here, _, gate = with_late_reader(tcp_rig)
    while here.connection.send(bytes(1_000_000)) == 0:
        assert here.connection.unsent() == 0
    assert here.drains == 0
    gate.set()
    tcp_rig.until(lambda: here.drains)
    assert here.connection.unsent() == 0
