"""Components that need no kernel, for the tests of what gives them turns."""

import threading
from collections.abc import Callable
from typing import Any

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Counter
from pancakes.kernel.stream import InformationStream

PATIENCE_S = 10.0


class NoKernel:
    """As much of a kernel as a component needs that neither publishes nor ticks nor ends.

    Attributes:
        said: what was logged.
    """

    agent = "a"

    def __init__(self):
        self.said = []
        self.ticks_heard = ()
        self.meter = None
        self.stream = InformationStream("a")

    def now(self):
        return 0.0

    def seq_of(self, address):
        return Counter(1)

    def log(self, level, text, traceback=""):
        self.said.append(text)


class Actor(ActorCore):
    """Does in its turns what it is told."""

    def __init__(self, dispatcher, address):
        kernel: Any = NoKernel()
        super().__init__(kernel, address)
        self.slices_s: list[float] = []
        dispatcher.attach(self)

    def take_turn(self, slice_s):
        self.slices_s.append(slice_s)
        super().take_turn(slice_s)

    def do(self, function):
        self.call(function)

    def tick(self, tick):
        """Does one thing more, after this."""
        self.call(lambda: None)


def holding(holds: threading.Event, gate: threading.Event) -> Callable[[], None]:
    """Returns what says by one event that it runs, and then waits for the other."""

    def hold() -> None:
        holds.set()
        gate.wait(PATIENCE_S)

    return hold


def put_back(mailbox):
    """Hands a mailbox's token back, as a turn does at its end, without a look at what came meanwhile."""
    mailbox.token.release()


def bounded(mailbox, channel, bounds):
    """Returns a mailbox's queue for a channel, with these bounds."""
    queue = mailbox.subscribe(channel)
    for type_name, keep in bounds.items():
        queue.bound(type_name, keep)
    return queue


def put(queue, packet, weight=0):
    """Puts a packet into a reader's queue for its channel, as the stream does."""
    queue.of(packet.type).put(packet, weight)


def take(queue):
    """Takes the oldest packet of a channel out; None if nothing waits."""
    return next(queue.drain(), None)


def drained(queue):
    """Takes all that waits in a queue out; returns the packets' numbers."""
    return [packet.seq for packet in queue.drain()]
