"""The network's loop: which sockets it serves, in which order it does what, and that nothing is lost in between."""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from pancakes.mesh import event_loop as module
from pancakes.mesh.event_loop import READ, Loop
from pancakes.testing import no_thread_left
from pancakes.util.clock import MonotonicClock

PATIENCE_S = 20.0


class Record:
    """What was done, in order, by the loop's threads."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._said = threading.Condition()

    def say(self, line: str) -> None:
        with self._said:
            self._lines.append(line)
            self._said.notify_all()

    def first(self, number: int) -> list[str]:
        """Returns all lines once there are so many."""
        with self._said:
            assert self._said.wait_for(lambda: len(self._lines) >= number, PATIENCE_S), self._lines
            return list(self._lines)


class Visitor:
    """A guest of a pool with so little to do that it can be counted.

    Attributes:
        stays: whether the loop's thread goes on.
        readied: what sockets have brought and has had no turn yet.
    """

    def __init__(self, done: Record) -> None:
        self.done = done
        self.stays = True
        self.readied: list[str] = []
        self.relieve: Callable[[], None] = lambda: None

    def arrive(self) -> bool:
        return True

    def work(self, until_s: float) -> None:
        for name in self.readied:
            self.done.say(f"turn {name}")
        self.readied.clear()

    def leave(self) -> None:
        self.work(0.0)


class Clock(MonotonicClock):
    """Goes as the host's clock, and leaps where a test wants it."""

    ahead_s = 0.0

    def now(self) -> float:
        return super().now() + self.ahead_s


class Rig:
    """A loop, and pairs of sockets whose near ends it watches."""

    def __init__(self) -> None:
        self.loop_clock = Clock()
        self.loop = Loop(self.loop_clock, "net-test")
        self.done = Record()
        self.visitor = Visitor(self.done)
        self.sockets: list[socket.socket] = []

    def within(self, function: Callable[[], object]) -> None:
        """Does something in the loop's thread, and waits for that."""
        over = threading.Event()

        def run() -> None:
            function()
            over.set()

        self.loop.call_later(0.0, run)
        assert over.wait(PATIENCE_S)

    def add(self, name: str, more: Callable[[], object] = lambda: None) -> socket.socket:
        """Watches one more socket, which says when it is read from, and brings a turn; returns it, ready to be read."""
        near, far = socket.socketpair()
        self.sockets += [near, far]
        near.setblocking(False)
        far.send(b"x")

        def served(_events: int) -> None:
            near.recv(1)
            self.visitor.readied.append(name)
            more()
            self.done.say(f"read {name}")

        self.loop.watch(near, READ, served)
        return near

    def lend(self) -> None:
        def make_guest(relieve: Callable[[], None]) -> Visitor:
            self.visitor.relieve = relieve
            return self.visitor

        self.loop.lend(make_guest)  # type: ignore[arg-type]


@pytest.fixture
def rig() -> Iterator[Rig]:
    with no_thread_left():
        made = Rig()
        yield made
        ending = threading.Thread(target=made.loop.stop, args=(lambda: None,), daemon=True)
        ending.start()
        ending.join(PATIENCE_S)
        for it in made.sockets:
            it.close()


def test_a_socket_that_one_before_it_has_given_up_is_not_served(rig: Rig) -> None:
    names = {"a": "b", "b": "a"}
    near: dict[str, socket.socket] = {}

    def give_up_the_other(name: str) -> Callable[[], None]:
        def give_up() -> None:
            other = near[names[name]]
            rig.loop.forget(other)
            other.close()
            # Most likely it gets the number of the one that was closed, which is ready, and it is not.
            again, far = socket.socketpair()
            rig.sockets.extend((again, far))
            rig.loop.watch(again, READ, lambda events: rig.done.say("served for another"))

        return give_up

    def both() -> None:
        near.update({name: rig.add(name, give_up_the_other(name)) for name in names})

    rig.within(both)
    (line,) = rig.done.first(1)
    rig.within(lambda: rig.done.say("over"))  # behind all sockets that were ready with the first
    assert rig.done.first(2) == [line, "over"] and line in ("read a", "read b")


@pytest.mark.parametrize(
    ("reading_s", "done"),
    [
        (0.0, ["read a", "turn a", "read b", "turn b"]),
        (math.inf, ["read a", "read b", "turn a", "turn b"]),
    ],
)
def test_after_much_reading_turns_come_before_more_is_read(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, reading_s: float, done: list[str]
) -> None:
    monkeypatch.setattr(module, "READING_S", reading_s)
    rig.lend()
    rig.within(lambda: (rig.add("a"), rig.add("b")))
    assert rig.done.first(4) == done


def test_what_came_while_this_process_stood_still_is_read_before_any_timer(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long the turns take in between: a timer may judge a peer by its silence."""
    monkeypatch.setattr(module, "READING_S", 0.0)
    rig.lend()

    def stand_still() -> None:
        rig.loop_clock.ahead_s += 10.0
        rig.loop.call_later(0.0, lambda: rig.done.say("timer"))

    rig.within(lambda: (rig.add("a", stand_still), rig.add("b", stand_still)))
    done = rig.done.first(6)
    assert sorted(done[:4]) == ["read a", "read b", "turn a", "turn b"] and done[4:] == ["timer", "timer"]


def test_it_waits_for_a_time_that_is_further_ahead_than_the_system_can_wait(rig: Rig) -> None:
    """A peer that says it sleeps for some years, and there is nothing else to do."""
    rig.loop.call_later(1e9, lambda: rig.done.say("too early"))
    for name in ("a", "b"):
        rig.within(partial(rig.add, name))
    assert sorted(rig.done.first(2)) == ["read a", "read b"]


def test_a_thread_that_does_not_stay_leaves_all_to_its_successor_also_where_that_comes_later(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "READING_S", 0.0)
    rig.lend()
    first = threading.Event()
    threads: list[threading.Thread] = []

    def leave() -> None:
        rig.visitor.stays = False
        threads.append(threading.current_thread())
        first.set()

    rig.within(lambda: (rig.add("a", leave), rig.add("b")))
    assert first.wait(PATIENCE_S)
    threads[0].join(PATIENCE_S)  # the watchdog has decided so, and starts the other thread a moment later
    assert rig.done.first(2) == ["read a", "turn a"] and not threads[0].is_alive()
    relieve = rig.visitor.relieve
    rig.visitor = Visitor(rig.done)
    relieve()
    assert rig.done.first(4) == ["read a", "turn a", "read b", "turn b"]


def test_a_loop_sleeps_between_packets_unless_it_is_told_otherwise(rig: Rig) -> None:
    assert rig.loop.busy_poll.busy_poll_s == 0.0
