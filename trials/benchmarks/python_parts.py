"""Measure what an agent is made of on one Python: processor time of a step of each, the smallest of five runs.

It needs only pykka and msgpack, so that it also runs on a Python on which Pancakes cannot be installed:

    python3.14t -m venv /tmp/t && /tmp/t/bin/pip install pykka msgpack
    /tmp/t/bin/python trials/benchmarks/python_parts.py

It prints a line of JSON, in microseconds. Run it for several Pythons in turns.
"""

from __future__ import annotations

import heapq
import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import msgpack
import pykka

ROUNDS = 5
ROW = ("system", "pose", "a/client/A", "", 1.5, 77, None, {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5})


class Reader(pykka.ThreadingActor):
    """Sets an event when it is told `end`."""

    def __init__(self, ended: threading.Event) -> None:
        super().__init__()
        self.ended = ended

    def on_receive(self, message: Any) -> None:
        """Take a message."""
        if message == "end":
            self.ended.set()


class Row:
    """What a packet is, more or less."""

    __slots__ = ("body", "seq", "source", "stamp_s")

    def __init__(self, seq: int, source: str, stamp_s: float, body: object) -> None:
        self.seq, self.source, self.stamp_s, self.body = seq, source, stamp_s, body


def delivery(count: int) -> None:
    """Tell an actor in another thread."""
    ended = threading.Event()
    reader = Reader.start(ended)
    for number in range(count):
        reader.tell(number)
    reader.tell("end")
    ended.wait()
    reader.stop()


def record(count: int) -> None:
    """Make an object with four fields."""
    for number in range(count):
        Row(number, "a/client/A", 0.5, None)


def mailbox(count: int) -> None:
    """Put into a queue and take out of it, with a lock each time."""
    lock, queue = threading.Lock(), deque[int]()
    for number in range(count):
        with lock:
            queue.append(number)
        with lock:
            queue.popleft()


def timer(count: int) -> None:
    """Put into a heap and take out of it."""
    heap: list[tuple[int, int]] = []
    for number in range(count):
        heapq.heappush(heap, (number * 7919 % 1000, number))
    while heap:
        heapq.heappop(heap)


def codec(count: int) -> None:
    """Encode a row and decode it."""
    for _ in range(count):
        msgpack.unpackb(msgpack.packb(ROW))


def computing(count: int) -> None:
    """Compute in pure Python."""
    total = 0
    for number in range(count):
        total += number * number % 7


STEPS: dict[str, tuple[Callable[[int], None], int]] = {
    "delivery": (delivery, 20_000),
    "record": (record, 200_000),
    "mailbox": (mailbox, 200_000),
    "timer": (timer, 50_000),
    "codec": (codec, 50_000),
    "computing": (computing, 1_000_000),
}


def measured(step: Callable[[int], None], count: int) -> float:
    """Return the processor time of one step, in microseconds."""
    best = float("inf")
    for _ in range(ROUNDS):
        began_s = time.process_time()
        step(count)
        best = min(best, time.process_time() - began_s)
    return round(best / count * 1e6, 3)


def figures(share: float = 1.0) -> dict[str, Any]:
    """Return all figures, with a share of the usual counts."""
    made = {name: measured(step, max(1, int(count * share))) for name, (step, count) in STEPS.items()}
    # Public in all but its name, and there from Python 3.13 on. Only now: a library may have turned it on.
    has_gil = vars(sys).get("_is_gil_enabled", lambda: True)()
    return {"python": sys.version.split()[0], "gil": has_gil, **made}


if __name__ == "__main__":
    print(json.dumps(figures()))
