"""What a thread is told while it waits for a point in time."""

import threading
import time
from collections import deque
from typing import Any

from pancakes.kernel.mailbox import Inbox

PATIENCE_S = 10.0


def test_messages_come_in_their_order():
    inbox = Inbox()
    for number in range(3):
        inbox.put(number)
    assert len(inbox) == 3 and [inbox.get() for _ in range(3)] == [0, 1, 2]
    assert inbox.empty()


def test_a_reader_that_waits_is_woken_by_a_message():
    inbox, got = Inbox(), []
    reader = threading.Thread(target=lambda: got.append(inbox.get()))
    reader.start()
    inbox.put("a message")
    reader.join(PATIENCE_S)
    assert got == ["a message"]


def test_a_reader_does_not_wait_where_there_is_a_message_or_no_time():
    inbox = Inbox()
    inbox.wait(0.0)
    inbox.wait(-1.0)
    inbox.put(1)
    inbox.put(2)
    inbox.get()
    inbox.wait(float("inf"))


def test_a_message_that_was_taken_ends_no_later_wait():
    """The timer would look into its book once more for each."""
    inbox = Inbox()
    inbox.put(1)
    inbox.get()
    began_s = time.monotonic()
    inbox.wait(0.05)
    assert time.monotonic() - began_s > 0.04


def test_a_message_that_comes_between_the_look_and_the_wait_is_not_slept_through():
    class Unseen(deque[Any]):
        """Is looked at, and then has something in it."""

        def __bool__(self):
            inbox.put("just now")
            return False

    class Overlooked(Inbox):
        def __init__(self):
            super().__init__()
            self._messages = Unseen()

    inbox = Overlooked()
    waiting = threading.Thread(target=lambda: inbox.wait(PATIENCE_S), daemon=True)
    waiting.start()
    waiting.join(PATIENCE_S / 2)
    assert not waiting.is_alive()
