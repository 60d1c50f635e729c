"""Messages that wait: in order, bounded, and the promised ones last."""

from __future__ import annotations

import threading

from pancakes_mqtt.message import Message
from pancakes_mqtt.spool import Spool


def message(name: str, qos: int = 1, size: int = 0) -> Message:
    return Message(name, b"x" * size, qos)


def taken(spool: Spool) -> list[str]:
    return [it.topic for it in iter(spool.take, None)]


def test_the_order_is_kept_whatever_is_promised() -> None:
    spool = Spool(10)
    for number in range(6):
        assert spool.put(message(str(number), number % 3))
    assert taken(spool) == list("012345") and spool.fallen_out == 0


def test_the_oldest_that_may_be_lost_falls_out_and_what_is_promised_stays() -> None:
    spool = Spool(3)
    assert all(spool.put(message(name, qos)) for name, qos in (("a", 0), ("b", 1), ("c", 0), ("d", 1)))
    assert spool.put(message("e", 0)) and spool.put(message("f", 1))
    assert not spool.put(message("g", 1)) and not spool.put(message("h", 0))
    assert taken(spool) == ["b", "d", "f"] and spool.fallen_out == 5


def test_bytes_are_bounded_and_one_large_message_may_wait() -> None:
    spool = Spool(10, most_bytes=100)
    assert spool.put(message("a", 1, 500))
    assert not spool.put(message("b", 1, 1))
    assert taken(spool) == ["a"]
    assert spool.put(message("c", 1, 60)) and not spool.put(message("d", 1, 60))


def test_what_is_not_promised_is_forgotten_where_the_broker_is_gone() -> None:
    spool = Spool(10, most_bytes=10)
    assert spool.put(message("a", 0, 5)) and spool.put(message("b", 1, 3))
    assert spool.forget_unpromised() == 1
    assert spool.put(message("c", 1, 5)) and taken(spool) == ["b", "c"] and spool.fallen_out == 1


def test_what_is_promised_waits_for_room_and_is_not_counted_meanwhile() -> None:
    spool = Spool(1)
    assert spool.put(message("a"))
    assert not spool.put_patiently(message("b"), 0.01) and spool.fallen_out == 0
    found: list[bool] = []
    waiting = threading.Thread(target=lambda: found.append(spool.put_patiently(message("c"), 10.0)))
    waiting.start()
    first = spool.take()
    waiting.join(5.0)
    assert found == [True] and first is not None and first.topic == "a" and taken(spool) == ["c"]


def test_a_thread_that_waits_for_room_goes_on_where_it_is_closed() -> None:
    spool = Spool(1)
    assert spool.put(message("a"))
    found: list[bool] = []
    waiting = threading.Thread(target=lambda: found.append(spool.put_patiently(message("b"), 10.0)))
    waiting.start()
    spool.close()
    waiting.join(5.0)
    assert found == [False] and not spool.put(message("c"))
