"""Queues are bounded in bytes where bodies can be large, and in packets all the same."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel.actors import put_back

from pancakes.errors import MailboxFull
from pancakes.kernel import channel_queue as module
from pancakes.kernel.channel_queue import ChannelQueue
from pancakes.kernel.handlers import Subscription
from pancakes.kernel.keep import MOST_BYTES, queue, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.shared_queue import SPARE_BYTES
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


def numbers(waiting: ChannelQueue) -> list[int]:
    return [packet.seq for packet in waiting.items]


def drained(waiting: ChannelQueue) -> list[int]:
    out = []
    while (packet := waiting.pop()) is not None:
        out.append(packet.seq)
    return out


def stream_with(keep: module.Keep, *types: str) -> tuple[InformationStream, ChannelQueue]:
    stream, mailbox = InformationStream("a"), opened()
    for name in types or ("heavy.blob",):
        stream.subscribe("a/client/R", mailbox, Subscription("system", name, keep))
    return stream, mailbox.queues["system"]


BOTH = pytest.mark.parametrize("types", [("heavy.blob",), ("heavy.blob", "pose")], ids=["one type", "several types"])


@BOTH
def test_the_oldest_fall_out_where_those_that_wait_are_too_large(types: tuple[str, ...]):
    stream, waiting = stream_with(queue(256), *types)
    for number in range(20):
        stream.publish(blob(number, MOST_BYTES // 4))
    assert drained(waiting) == [16, 17, 18, 19]
    assert waiting.dropped() == 16
    assert waiting.heavy_bytes == 0


@BOTH
def test_one_packet_may_always_wait_however_large(types: tuple[str, ...]):
    stream, waiting = stream_with(reliable(256), *types)
    stream.publish(blob(1, MOST_BYTES + 1))
    with pytest.raises(MailboxFull, match=r"1 \(\d+ bytes\) wait already"):
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
        except MailboxFull:
            waiting.pop()
        else:
            accepted.append(number)
    left = drained(waiting)
    assert left == accepted[-len(left) :] and len(left) >= 3
    assert waiting.dropped() == 0


@BOTH
def test_small_bodies_are_bounded_by_their_number_alone(types: tuple[str, ...]):
    stream, waiting = stream_with(queue(256), *types)
    for number in range(300):
        stream.publish(blob(number, 64))
    assert drained(waiting) == list(range(44, 300))
    assert not waiting.heavy


def test_from_another_agent_who_has_room_gets_it_and_the_loss_of_who_has_none_is_counted():
    stream, full = stream_with(reliable(1))
    other = opened()
    stream.subscribe("a/client/Other", other, Subscription("system", "heavy.blob", queue(9)))
    stream.inject(blob(1, 3000))
    for number in (2, 3):
        with pytest.raises(MailboxFull):
            stream.inject(blob(number, 3000 * (number % 2)))
    assert drained(other.queues["system"]) == [1, 2, 3]
    assert drained(full) == [1]
    assert full.dropped() == 2
    told = {row["address"]: row["dropped"] for row in stream.describe("system")}
    assert told == {"a/client/R": 2, "a/client/Other": 0}


@given(
    st.integers(1, 6),
    st.lists(st.one_of(st.just("light"), st.just("pop"), st.integers(1, 60)), max_size=60),
)
def test_whatever_comes_order_and_bounds_hold_and_the_scales_come_back_to_zero(limit, steps):
    """Heavy packets weigh up to 60 and 100 may wait; a light one pushes the oldest out whatever that weighs."""
    waiting = opened().subscribe("system", {"heavy.blob": queue(limit)})
    weights: dict[int, int] = {}
    taken: list[int] = []
    before, module.MOST_BYTES = module.MOST_BYTES, 100
    try:
        for number, step in enumerate(steps):
            if step == "pop":
                packet = waiting.pop()
                taken += [packet.seq] if packet is not None else []
            elif step == "light":
                waiting.put(blob(number))
                weights[number] = 0
            else:
                waiting.put_heavy(blob(number), step)
                weights[number] = step
            left = numbers(waiting)
            assert len(left) <= limit
            assert sum(weights[it] for it in left) <= 100
            assert waiting.heavy_bytes >= sum(weights[it] for it in left)
    finally:
        module.MOST_BYTES = before
    last = numbers(waiting)
    assert taken + last == sorted(taken + last)
    if weights:
        assert max(weights) in taken + last, "the newest is never what falls out"
    assert waiting.dropped() == (len(weights) - len(taken) - len(last) if limit > 1 else 0)
    drained(waiting)
    waiting.put_heavy(blob(0), 7)
    assert waiting.heavy_bytes == 7


@given(st.lists(st.one_of(st.just("pop"), st.integers(1, 60)), max_size=60))
def test_no_more_falls_out_than_must(steps):
    waiting = opened().subscribe("system", {"heavy.blob": queue(5)})
    model: deque[tuple[int, int]] = deque()
    before, module.MOST_BYTES = module.MOST_BYTES, 100
    try:
        for number, step in enumerate(steps):
            if step == "pop":
                packet = waiting.pop()
                assert (packet.seq if packet else None) == (model.popleft()[0] if model else None)
                continue
            while model and (len(model) >= 5 or sum(weight for _, weight in model) + step > 100):
                model.popleft()
            model.append((number, step))
            waiting.put_heavy(blob(number), step)
            assert numbers(waiting) == [number for number, _ in model]
            assert waiting.heavy_bytes == sum(weight for _, weight in model)
    finally:
        module.MOST_BYTES = before


def test_many_threads_at_once_leave_the_scales_right():
    stream, waiting = stream_with(queue(64))
    sizes = (100, 5000, 200_000, 900_000)
    over = threading.Event()
    most = 0

    def publish(first: int) -> None:
        for number in range(first, first + 500):
            stream.publish(blob(number, sizes[number % 4]))

    def read() -> None:
        nonlocal most
        while not over.is_set():
            most = max(most, sum(len(packet.body.data) for packet in list(waiting.items)))
            waiting.pop()

    threads = [threading.Thread(target=publish, args=(first,)) for first in (0, 1000, 2000)]
    reader = threading.Thread(target=read)
    for thread in (reader, *threads):
        thread.start()
    for thread in threads:
        thread.join()
    over.set()
    reader.join()
    assert most <= MOST_BYTES + 64 * 1024
    drained(waiting)
    stream.publish(blob(1, 5000))
    assert waiting.heavy_bytes == 5000


@pytest.mark.parametrize("others", [{}, {"heavy.other": queue(9)}])
def test_heavy_packets_weigh_the_same_in_the_queue_that_they_move_to(others):
    mailbox = opened()
    before = mailbox.subscribe("system", {"heavy.blob": queue(64), **others})
    packet = blob(1, 5000)
    before.put_heavy(packet, 5000)
    after = mailbox.subscribe("system", {"heavy.third": queue(9)})
    assert after is not before
    assert after.heavy_bytes == 5000
    assert drained(after)
    assert after.heavy_bytes == 0


@pytest.mark.parametrize("others", [{}, {"heavy.other": queue(9)}])
def test_a_heavy_packet_that_is_put_back_is_heavy_again(others):
    waiting = opened().subscribe("system", {"heavy.blob": queue(64), **others})
    waiting.put_heavy(blob(1, 5000), 5000)
    packet = waiting.pop()
    assert waiting.heavy_bytes == 0
    waiting.push_back(packet)
    assert waiting.heavy_bytes == 5000
    assert waiting.pop() is packet
    assert waiting.heavy_bytes == 0


def test_heavy_packets_that_have_fallen_out_of_a_shared_queue_do_not_stay_in_memory():
    stream, waiting = stream_with(queue(64), "heavy.blob", "pose")
    for number in range(300):
        stream.publish(blob(number, MOST_BYTES // 30))
        weights = [len(packet.body.data) for packet in waiting.items]
        assert sum(weights) <= MOST_BYTES + SPARE_BYTES + 2 * weights[-1]
    assert drained(waiting) == list(range(270, 300))
    assert waiting.heavy_bytes == 0
