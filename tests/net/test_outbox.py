"""What waits for a slow peer, channel by channel."""

from __future__ import annotations

import pytest

from pancakes.errors import MailboxFull
from pancakes.migration.pieces import PIECE_BYTES
from pancakes.migration.snapshot import LIMIT_BYTES
from pancakes.net.outbox import MAX_BYTES, MAX_PACKETS, Counters, Message, Outbox, PeerBusy


def make():
    counters = Counters()
    return Outbox("b", counters), counters


def put(outbox, channel, data, source="a", counts=True):
    outbox.put(channel, (source, "type", "b"), Message(data, counts))


def take_all(outbox):
    messages, _ = outbox.take(1 << 40)
    return messages


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
    assert isinstance(caught.value, MailboxFull)
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


def test_the_other_channels_and_blobs_take_turns():
    outbox, _ = make()
    for index in range(3):
        put(outbox, "chat", b"c%d" % index)
        put(outbox, "log", b"l%d" % index)
    outbox.put_blob(Message(b"b%d" % index, True) for index in range(4))
    outbox.put_blob(Message(b"B%d" % index, True) for index in range(2))
    assert take_all(outbox) == [
        *(b"c0", b"b0", b"l0", b"b1", b"c1", b"b2", b"l1", b"b3"),
        *(b"c2", b"l2", b"B0", b"B1"),
    ]


def test_only_so_many_blobs_wait():
    outbox, _ = make()
    for _ in range(4):
        outbox.put_blob(iter([Message(b"x", True)]))
    with pytest.raises(PeerBusy, match="4 snapshots"):
        outbox.put_blob(iter([]))


def test_a_batch_ends_where_the_limit_is_reached_and_counts_what_counts():
    outbox, _ = make()
    for counts in (True, False, True, True):
        put(outbox, "chat", b"12345", counts=counts)
    assert outbox.take(10) == ([b"12345"] * 2, 1)
    assert outbox.waiting() == {"chat": 2}
    assert outbox.take(1) == ([b"12345"], 1)
    assert outbox.take(100) == ([b"12345"], 1)
    assert outbox.take(100) == ([], 0)
