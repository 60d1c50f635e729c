"""Queues are bounded in bytes where bodies can be large, and in packets all the same."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel.actors import bounded, drained, put, put_back, take

from pancakes.errors import MailboxFullError
from pancakes.kernel.handlers import MOST_BYTES, QueuePolicy, Subscription, drop_oldest, reliable
from pancakes.kernel.mailbox import ChannelQueue, Mailbox
from pancakes.kernel.stream import InformationStream
from pancakes.packet import Packet, packet_type


@packet_type("heavy.blob")
@dataclass(frozen=True)
class Blob:
    number: int
    data: bytes


class Dispatcher:
    def ready(self, mailbox: Mailbox) -> None:
        pass


def opened() -> Mailbox:
    mailbox = Mailbox()
    mailbox.dispatch = Dispatcher()
    put_back(mailbox)
    return mailbox


def blob(number: int, size: int = 0, kind: str = "heavy.blob") -> Packet:
    return Packet("system", kind, "a/client/T", "", 0.0, number, Blob(number, bytes(size)))


def stream_with(keep: QueuePolicy, *types: str) -> tuple[InformationStream, ChannelQueue]:
    stream, mailbox = InformationStream("a"), opened()
    for name in types or ("heavy.blob",):
        stream.subscribe("a/client/R", mailbox, Subscription("system", name, keep))
    return stream, mailbox.queues["system"]


BOTH = pytest.mark.parametrize("types", [("heavy.blob",), ("heavy.blob", "pose")], ids=["one type", "several types"])


@BOTH
def test_the_oldest_fall_out_where_those_that_wait_are_too_large(types: tuple[str, ...]):
    stream, waiting = stream_with(drop_oldest(256), *types)
    for number in range(20):
        stream.publish(blob(number, MOST_BYTES // 4))
    assert drained(waiting) == [16, 17, 18, 19]
    assert waiting.dropped() == 16
    assert waiting.heavy_bytes == 0


def test_16_mib_wait_under_a_subscription():
    _, waiting = stream_with(drop_oldest(256))
    for number in range(17):
        put(waiting, blob(number, 2**20), 2**20)
    assert [taken.seq for taken in waiting.drain()] == list(range(1, 17))


@BOTH
def test_one_packet_may_always_wait_however_large(types: tuple[str, ...]):
    stream, waiting = stream_with(reliable(256), *types)
    stream.publish(blob(1, MOST_BYTES + 1))
    with pytest.raises(MailboxFullError, match=r"1 \(\d+ bytes\) wait already"):
        stream.publish(blob(2, 3000))
    assert drained(waiting) == [1]
    stream.publish(blob(3, MOST_BYTES + 1))
    assert drained(waiting) == [3]


@BOTH
def test_a_reliable_reader_has_room_again_once_it_has_read(types: tuple[str, ...]):
    stream, waiting = stream_with(reliable(256), *types)
    accepted = []
    for number in range(40):
        try:
            stream.publish(blob(number, MOST_BYTES // 4))
        except MailboxFullError:
            take(waiting)
        else:
            accepted.append(number)
    left = drained(waiting)
    assert left == accepted[-len(left) :] and len(left) >= 3
    assert waiting.dropped() == 0


@BOTH
def test_small_bodies_are_bounded_by_their_number_alone(types: tuple[str, ...]):
    stream, waiting = stream_with(drop_oldest(256), *types)
    for number in range(300):
        stream.publish(blob(number, 64))
    assert drained(waiting) == list(range(44, 300))
    assert waiting.heavy_bytes == 0


def test_a_packet_from_another_agent_reaches_readers_with_room_and_each_loss_is_counted():
    stream, full = stream_with(reliable(1))
    other = opened()
    stream.subscribe("a/client/Other", other, Subscription("system", "heavy.blob", drop_oldest(9)))
    stream.inject(blob(1, 3000))
    for number in (2, 3):
        with pytest.raises(MailboxFullError):
            stream.inject(blob(number, 3000 * (number % 2)))
    assert drained(other.queues["system"]) == [1, 2, 3]
    assert drained(full) == [1]
    assert full.dropped() == 2
    told = {row["address"]: row["dropped"] for row in stream.describe("system")}
    assert told == {"a/client/R": 2, "a/client/Other": 0}


UNIT = MOST_BYTES // 100


@given(st.integers(1, 6), st.lists(st.one_of(st.just("take"), st.integers(0, 60)), max_size=60))
def test_no_more_falls_out_than_must(limit, steps):
    """Packets weigh up to 60 units, and 100 may wait."""
    waiting = bounded(opened(), "system", {"heavy.blob": drop_oldest(limit)})
    model: deque[tuple[int, int]] = deque()
    lost = 0
    for number, step in enumerate(steps):
        if step == "take":
            packet = take(waiting)
            assert (packet.seq if packet else None) == (model.popleft()[0] if model else None)
            continue
        while model and (len(model) >= limit or (step and sum(weight for _, weight in model) + step > 100)):
            model.popleft()
            lost += limit > 1
        model.append((number, step))
        put(waiting, blob(number), step * UNIT)
        assert waiting.heavy_bytes == sum(weight for _, weight in model) * UNIT
    assert waiting.dropped() == lost
    assert drained(waiting) == [number for number, _ in model]
    assert waiting.heavy_bytes == 0


def test_many_threads_at_once_leave_the_scales_right():
    stream, waiting = stream_with(drop_oldest(64))
    sizes = (100, 5000, 200_000, 900_000)
    over = threading.Event()
    most = 0

    def publish(first: int) -> None:
        for number in range(first, first + 200):
            stream.publish(blob(number, sizes[number % 4]))

    def read() -> None:
        nonlocal most
        while not over.wait(0.0001):
            most = max(most, waiting.heavy_bytes)
            take(waiting)

    threads = [threading.Thread(target=publish, args=(first,)) for first in (0, 1000, 2000)]
    reader = threading.Thread(target=read)
    for thread in (reader, *threads):
        thread.start()
    for thread in threads:
        thread.join()
    over.set()
    reader.join()
    assert 0 < most <= MOST_BYTES
    drained(waiting)
    stream.publish(blob(1, 5000))
    assert waiting.heavy_bytes == 5000


@pytest.mark.parametrize("others", [{}, {"heavy.other": drop_oldest(9)}])
def test_a_heavy_packet_that_is_put_back_is_heavy_again(others):
    waiting = bounded(opened(), "system", {"heavy.blob": drop_oldest(64), **others})
    put(waiting, blob(1, 5000), 5000)
    packet = take(waiting)
    assert waiting.heavy_bytes == 0
    waiting.of("heavy.blob").put_back(packet)
    assert waiting.heavy_bytes == 5000
    assert take(waiting) is packet
    assert waiting.heavy_bytes == 0
