"""What waits for a slow disk or terminal: bounded in packets and in bytes, the newest stay, and losses are counted."""

import msgspec
import pytest

from pancakes.devices import Load
from pancakes.kernel.mailbox import Backlog
from pancakes.packet import Packet

KIB = 1024


class Picture(msgspec.Struct):
    """A body that may be of any size."""

    pixels: bytes


@pytest.fixture
def backlog():
    return Backlog(limit=10, most_bytes=100 * KIB)


def put(backlog, number, kib=None):
    body = Load(0.5) if kib is None else Picture(b"\0" * (kib * KIB))
    backlog.put(Packet("system", "x", "a/client/X", "", 0.0, number, body), number)


def rest(backlog):
    return [backlog.take() for _ in range(len(backlog))]


def test_what_is_put_is_taken_in_order_until_nothing_waits(backlog):
    put(backlog, 1)
    put(backlog, 2, kib=3)
    assert (backlog.take(), backlog.take(), backlog.take()) == (1, 2, None)
    assert (backlog.dropped, backlog.heavy_bytes) == (0, 0)


def test_of_too_many_the_oldest_fall_out_and_are_counted(backlog):
    for number in range(13):
        put(backlog, number)
    assert backlog.dropped == 3
    assert rest(backlog) == list(range(3, 13))


def test_of_large_ones_fewer_wait(backlog):
    for number in range(8):
        put(backlog, number, kib=30)
    assert backlog.heavy_bytes == 90 * KIB
    assert backlog.dropped == 5
    assert rest(backlog) == [5, 6, 7]
    assert backlog.heavy_bytes == 0


def test_as_many_bytes_wait_as_there_is_room_for_and_not_one_more(backlog):
    for number in range(4):
        put(backlog, number, kib=25)
    assert backlog.dropped == 0 and backlog.heavy_bytes == 100 * KIB
    put(backlog, 4, kib=5)
    assert backlog.dropped == 1


def test_64_mib_wait_unless_it_is_told_otherwise():
    backlog: Backlog[int] = Backlog(limit=10)
    frame = Picture(bytes(16 * KIB * KIB))
    for number in range(5):
        backlog.put(Packet("system", "x", "a/client/X", "", 0.0, number, frame), number)
    assert rest(backlog) == [1, 2, 3, 4]


def test_one_that_is_larger_than_the_bound_may_wait_alone(backlog):
    put(backlog, 1)
    put(backlog, 2, kib=500)
    assert (len(backlog), backlog.dropped) == (1, 1)
    put(backlog, 3, kib=5)
    assert (rest(backlog), backlog.dropped) == ([3], 2)


def test_a_large_one_that_light_ones_push_out_weighs_no_more(backlog):
    put(backlog, 0, kib=90)
    for number in range(1, 11):
        put(backlog, number)
    assert backlog.heavy_bytes == 0
    put(backlog, 11, kib=90)
    assert rest(backlog) == [*range(2, 12)]


def test_what_is_cleared_was_not_lost(backlog):
    put(backlog, 1, kib=30)
    backlog.clear()
    assert (len(backlog), backlog.heavy_bytes, backlog.dropped) == (0, 0, 0)
