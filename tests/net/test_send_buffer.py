"""What waits for a slow peer, channel by channel."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.durable.snapshot import LIMIT_BYTES, PIECE_BYTES
from pancakes.errors import MailboxFullError
from pancakes.mesh.session import (
    MAX_BYTES,
    MAX_PACKETS,
    MOST_GONE,
    Counters,
    Message,
    PeerBusy,
    PeerCounters,
    SendBuffer,
)


def make():
    counters = Counters()
    return SendBuffer("b", counters), counters


HEAD = b"head"


def put(outbox, channel, data, source="a", counts=True):
    outbox.put(channel, (source, "type", "b"), Message(data, counts, HEAD))


def take(outbox, limit_bytes):
    return [message.data for message in outbox.take(limit_bytes)]


def take_all(outbox):
    return take(outbox, 1 << 40)


def number(index):
    return index.to_bytes(4, "big")


def test_of_system_the_newest_of_each_source_waits_at_its_place():
    outbox, counters = make()
    for data, source in [(b"1", "x"), (b"2", "y"), (b"3", "x"), (b"4", "x")]:
        put(outbox, "system", data, source)
    assert take_all(outbox) == [b"4", b"2"]
    assert counters.dropped == {"system": 2}
    put(outbox, "system", b"5", "x")
    assert take_all(outbox) == [b"5"], "what was taken is not replaced"


@pytest.mark.parametrize("channel", ["log", "system"])
def test_the_oldest_fall_out_where_there_are_too_many(channel):
    outbox, counters = make()
    for index in range(MAX_PACKETS + 10):
        put(outbox, channel, number(index), source=str(index))
    assert take_all(outbox) == [number(index) for index in range(10, MAX_PACKETS + 10)]
    assert counters.dropped == {channel: 10}


@pytest.mark.parametrize("channel", ["log", "system"])
def test_the_oldest_fall_out_where_they_are_too_large(channel):
    outbox, counters = make()
    for index in range(6):
        put(outbox, channel, bytes([index]) * (MAX_BYTES // 4), source=str(index))
    assert [data[0] for data in take_all(outbox)] == [2, 3, 4, 5]
    assert counters.dropped == {channel: 2}


@pytest.mark.parametrize("channel", ["ctrl", "chat", "sysctrl", "network"])
def test_other_channels_have_a_window(channel):
    outbox, counters = make()
    for index in range(MAX_PACKETS):
        put(outbox, channel, number(index))
    with pytest.raises(PeerBusy, match=f"b is slow: 1024 packets .* on {channel}") as caught:
        put(outbox, channel, b"one more")
    assert isinstance(caught.value, MailboxFullError)
    put(outbox, "another", b"has a window of its own")
    assert len(take_all(outbox)) == MAX_PACKETS + 1
    put(outbox, channel, b"room again")
    assert counters.dropped == {}


def test_a_window_is_bounded_in_bytes_too_but_one_packet_may_always_wait():
    outbox, _ = make()
    put(outbox, "chat", bytes(MAX_BYTES + 1))
    with pytest.raises(PeerBusy):
        put(outbox, "chat", b"x")
    assert len(take_all(outbox)) == 1
    put(outbox, "chat", b"x")


def test_the_largest_snapshot_waits_whole_and_once_more():
    """In pieces; where the last of them fell out each time, it would never arrive over a slow link."""
    outbox, _ = make()
    pieces = 2 * (LIMIT_BYTES // PIECE_BYTES)
    for index in range(pieces):
        put(outbox, "network", bytes(PIECE_BYTES + 200), source=str(index))
    assert len(take_all(outbox)) == pieces


def test_control_and_migration_go_first():
    outbox, _ = make()
    for channel in ("log", "chat", "network", "sysctrl"):
        put(outbox, channel, channel.encode())
    assert take_all(outbox) == [b"sysctrl", b"network", b"log", b"chat"]


def test_the_other_channels_take_turns():
    outbox, _ = make()
    for index in range(3):
        put(outbox, "chat", b"c%d" % index)
        put(outbox, "log", b"l%d" % index)
    assert take_all(outbox) == [b"c0", b"l0", b"c1", b"l1", b"c2", b"l2"]


def test_a_batch_ends_where_the_limit_is_reached():
    outbox, _ = make()
    for counts in (True, False, True, True):
        put(outbox, "chat", b"12345", counts=counts)
    assert outbox.take(10) == [Message(b"12345", True, HEAD), Message(b"12345", False, HEAD)]
    assert outbox.waiting() == {"chat": 2}
    assert outbox.take(1) == [Message(b"12345", True, HEAD)]
    assert outbox.take(100) == [Message(b"12345", True, HEAD)]
    assert outbox.take(100) == []


def test_two_types_of_one_source_never_overtake_each_other():
    outbox, counters = make()
    for data, kind in [(b"1", "pose"), (b"2", "battery"), (b"3", "pose")]:
        outbox.put("system", ("a", kind, "b"), Message(data, True, HEAD))
    assert take_all(outbox) == [b"2", b"3"]
    assert counters.dropped == {"system": 1}


def test_a_source_that_publishes_all_the_time_does_not_starve():
    """Nor do the types of a source of which one has become newer each time that the link has room."""
    outbox, _ = make()
    sent: list[bytes] = []
    for round_ in range(20):
        for source in ("x", "y"):
            for kind in (b"a", b"b"):
                outbox.put("system", (source, kind.decode(), "b"), Message(source.encode() + kind, True, HEAD))
                sent += take(outbox, 1) if round_ else []
    counts = {data: sent.count(data) for data in (b"xa", b"xb", b"ya", b"yb")}
    assert min(counts.values()) >= 10, counts


@given(st.data())
def test_whatever_waits_leaves_in_the_order_of_its_source(data):
    """And of each type of each source the newest is never lost."""
    outbox, counters = make()
    newest: dict[tuple[str, str], int] = {}
    taken: list[tuple[str, str, int]] = []

    def take_some() -> None:
        for message in take(outbox, data.draw(st.integers(1, 3))):
            source, kind, text = message.decode().split()
            taken.append((source, kind, int(text)))

    puts = data.draw(st.lists(st.tuples(st.sampled_from("xy"), st.sampled_from("abc"), st.booleans()), max_size=40))
    for seq, (source, kind, takes) in enumerate(puts):
        outbox.put("system", (source, kind, "b"), Message(f"{source} {kind} {seq}".encode(), True, HEAD))
        newest[source, kind] = seq
        if takes:
            take_some()
    while outbox.waiting():
        take_some()
    for source in "xy":
        numbers = [seq for whose, _, seq in taken if whose == source]
        assert numbers == sorted(set(numbers))
    assert {(source, kind): seq for source, kind, seq in taken} == newest
    assert len(taken) + counters.dropped.get("system", 0) == len(puts)


def test_a_peer_that_comes_back_goes_on_with_its_counters_unless_too_many_have_come_since():
    counters = PeerCounters()
    stays, goes = counters.of("stays", ["stays"]), counters.of("goes", ["stays"])
    assert counters.of("goes", ["stays"]) is goes
    for number in range(MOST_GONE):
        counters.of(f"guest{number}", ["stays"])
    assert counters.of("goes", ["stays"]) is goes
    for number in range(MOST_GONE):
        counters.of(f"another{number}", ["stays"])
    assert "goes" in counters and "guest1" not in counters, "it came again after them"
    counters.of("one more", ["stays"])
    assert counters.of("goes", ["stays"]) is not goes
    assert counters.of("stays", ["stays"]) is stays, "it never was away"


def test_so_many_peers_that_have_gone_are_counted_and_no_more():
    counters = PeerCounters()
    for number in range(3 * MOST_GONE):
        counters.of(f"guest{number}", []).packets_out = 1
    known = [number for number in range(3 * MOST_GONE) if f"guest{number}" in counters]
    assert known == list(range(2 * MOST_GONE - 1, 3 * MOST_GONE))
    counters.forget(f"guest{known[-1]}")
    assert f"guest{known[-1]}" not in counters


def test_what_two_links_with_one_peer_drop_at_once_is_all_counted():
    counters = Counters()
    other = threading.Thread(target=lambda: counters.drop("chat"))

    class Dropped(dict):
        """Lets the other thread count while one is at it."""

        def get(self, channel, default=None):
            count = super().get(channel, default)
            if other.ident is None:
                other.start()
                other.join(0.05)  # as long as one needs that does not wait
            return count

    counters.dropped = Dropped()
    counters.drop("chat")
    other.join()
    assert counters.dropped == {"chat": 2}
