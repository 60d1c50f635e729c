"""A session by itself: what it gives to a connection that takes little."""

from __future__ import annotations

import math

from pancakes.mesh.codec import encode_link_message
from pancakes.mesh.messages import Identity, Pong
from pancakes.mesh.session import MOST_UNSENT_BYTES, Gate, Message, Session, Train
from pancakes.mesh.transport import Connection
from pancakes.packet import Fence


class Nobody:
    """An owner that does nothing."""

    def session_opened(self, session: Session) -> None:
        pass

    def session_received(self, session: Session, data: bytes) -> None:
        pass

    def session_closed(self, session: Session, reason: str) -> None:
        pass


class Slow(Connection):
    """A connection whose other end takes what a test lets it take."""

    remote = "tcp://127.0.0.1:1"

    def __init__(self) -> None:
        self.waiting = 0

    def send(self, data: bytes) -> int:
        self.waiting += len(data)
        return self.waiting

    def unsent(self) -> int:
        return self.waiting

    def close(self, reason: str = "") -> None:
        pass


def test_the_answers_to_endless_pings_that_nobody_takes_do_not_fill_the_memory() -> None:
    session = Session(Nobody(), 1, "", lambda: 0.0)
    connection = Slow()
    session.opened(connection)
    pong = encode_link_message(Pong(1, 0.0)) * 1000
    for _ in range(2 * MOST_UNSENT_BYTES // len(pong)):
        session.send_link(pong)
    assert MOST_UNSENT_BYTES < connection.waiting < MOST_UNSENT_BYTES + 2 * len(pong)
    before = connection.waiting = 0
    session.send_link(pong)
    assert connection.waiting > before, "it has taken what waited, and is spoken to again"


def test_a_link_is_quiet_since_its_last_packet_went_either_way() -> None:
    session = Session(Nobody(), 1, "", lambda: 0.0)
    session.hello = Identity("a", "journal", role="client").hello()
    assert session.quiet_s(100.0) == math.inf, "none ever came in"
    session.hello = Identity("a", "journal").hello()
    assert session.quiet_s(100.0) == 100.0, "an agent need not say anything"
    session.counters.packets_in = 1
    assert (session.quiet_s(100.0), session.quiet_s(103.0)) == (0.0, 3.0)
    session.counters.packets_out = 1
    assert (session.quiet_s(104.0), session.quiet_s(106.0)) == (0.0, 2.0)


def test_a_link_on_which_one_packet_comes_in_at_once_is_quiet_since_then() -> None:
    session = Session(Nobody(), 1, "", lambda: 0.0)
    session.counters.packets_in = 1
    assert (session.quiet_s(100.0), session.quiet_s(103.0)) == (0.0, 3.0)


def test_a_peer_is_stuck_since_it_last_took_a_byte() -> None:
    session = Session(Nobody(), 1, "", lambda: 0.0)
    connection = Slow()
    session.opened(connection)
    assert session.stuck_s(10.0) == 0.0
    session.send_link(bytes(100))
    assert session.stuck_s(11.0) == 1.0, "nothing was taken since it was last seen to wait for nothing"
    connection.waiting -= 1
    assert session.stuck_s(12.0) == 0.0
    assert session.stuck_s(14.5) == 2.5
    connection.waiting = 0
    assert session.stuck_s(15.0) == 0.0


class Taken(Slow):
    """A connection that takes all, and keeps it."""

    def __init__(self) -> None:
        super().__init__()
        self.data: list[bytes] = []

    def send(self, data: bytes) -> int:
        self.data.append(data)
        return self.waiting


SCAN, OTHER = Fence("a/Scan", (1, "a")), Fence("a/Other", (1, "a"))


class Rights:
    """Rights that a test ends, and what was held back."""

    def __init__(self) -> None:
        self.ended: set[Fence] = set()
        self.held_back: list[tuple[str, int]] = []

    def gate(self) -> Gate:
        return Gate(
            lambda fence: fence not in self.ended,
            lambda fence, packets: self.held_back.append((fence.task_id, packets)),
        )


def speaking(rights: Rights, connection: Connection) -> Session:
    session = Session(Nobody(), 1, "", lambda: 0.0, rights.gate())
    session.opened(connection)
    return session


def train(session: Session, row: bytes, fence: Fence | None, rows: int = 1) -> Train:
    return Train("system", b"\x97", (session,), [row] * rows, 0, fence)


def test_what_rests_on_a_right_that_has_ended_does_not_leave_and_the_rest_does() -> None:
    rights, connection = Rights(), Taken()
    session = speaking(rights, connection)
    rights.ended.add(SCAN)
    session.send([train(session, b"scan", SCAN, 3), train(session, b"other", OTHER), train(session, b"free", None)])
    (data,) = connection.data
    assert b"other" in data and b"free" in data and b"scan" not in data
    assert rights.held_back == [("a/Scan", 3)] and session.counters.dropped == {"system": 3}
    assert session.counters.packets_out == 2
    session.send([train(session, b"scan", SCAN)])
    assert len(connection.data) == 1, "nothing is left to send"


def test_what_has_waited_for_a_slow_peer_does_not_leave_after_its_right_has_ended() -> None:
    rights, connection = Rights(), Taken()
    session = speaking(rights, connection)
    connection.waiting = 1
    session.send([train(session, b"first", None)])
    assert session.congested
    for name, fence in ((b"scan", SCAN), (b"other", OTHER)):
        session.offer("chat", ("a/client/X", "t", "b"), Message(name, True, b"\x97", fence))
    rights.ended.add(SCAN)
    connection.waiting = 0
    session.drained()
    sent = b"".join(connection.data)
    assert b"other" in sent and b"scan" not in sent and not session.congested
    assert rights.held_back == [("a/Scan", 1)] and session.counters.dropped == {"chat": 1}
    session.offer("chat", ("a/client/X", "t", "b"), Message(b"again", True, b"\x97", SCAN))
    assert b"again" not in b"".join(connection.data) and rights.held_back == [("a/Scan", 1)] * 2


def test_what_is_sent_once_the_connection_has_closed_is_counted_as_given_up() -> None:
    connection = Taken()
    session = speaking(Rights(), connection)
    session.send([train(session, b"\xc0", None)])
    assert len(connection.data) == 1 and session.counters.dropped == {}
    session.closed("the other side closed the connection")
    session.send([train(session, b"\xc0", None, rows=3)])
    session.offer("ctrl", ("a", "b", "c"), Message(b"\xc0", True, b"\x97"))
    assert len(connection.data) == 1 and session.counters.dropped == {"system": 3, "ctrl": 1}
