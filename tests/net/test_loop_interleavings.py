"""The network's loop: in which thread it runs, that it is one at a time, and when it ends."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from pancakes.mesh.event_loop import READ, Loop
from pancakes.testing import no_thread_left

PATIENCE_S = 10.0


class Clock:
    """A clock that a test moves, or that moves by itself whenever it is asked."""

    def __init__(self, step_s: float = 0.0) -> None:
        self.now_s = 0.0
        self._step_s = step_s

    def now(self) -> float:
        self.now_s += self._step_s
        return self.now_s


class Visitor:
    """A guest that is always welcome, and in whose turns a test does what it wants."""

    def __init__(self, relieve: Callable[[], None]) -> None:
        self.relieve = relieve
        self.stays = True
        self.during: Callable[[Visitor], None] = lambda guest: None
        self.leaves: Callable[[], None] = lambda: None

    def arrive(self) -> bool:
        return True

    def work(self, until_s: float) -> None:
        during, self.during = self.during, lambda guest: None
        during(self)

    def leave(self) -> None:
        self.leaves()


class Bell:
    """Something that becomes ready to be read; notes in which thread it is read."""

    def __init__(self, loop: Loop) -> None:
        self._reader, self._writer = socket.socketpair()
        self._loop = loop
        self.threads: list[threading.Thread] = []
        self.heard = threading.Semaphore(0)
        self.hears: Callable[[], None] = lambda: None
        in_loop(loop, lambda: loop.watch(self._reader, READ, self._hear))

    def ring(self) -> None:
        self._writer.send(b"x")

    def _hear(self, _events: int) -> None:
        self._reader.recv(1)
        self.threads.append(threading.current_thread())
        self.hears()
        self.heard.release()

    def forget(self) -> None:
        self._loop.forget(self._reader)

    def close(self) -> None:
        self._reader.close()
        self._writer.close()


class Rig:
    """A loop, and what it watches."""

    def __init__(self, clock: Any) -> None:
        self.clock = clock
        self.loop = Loop(clock, "net")
        self.guests: list[Visitor] = []
        self._bells: list[Bell] = []

    def lend(self) -> None:
        def make(relieve: Callable[[], None]) -> Any:
            self.guests.append(Visitor(relieve))
            return self.guests[-1]

        self.loop.lend(make)

    def bell(self) -> Bell:
        self._bells.append(Bell(self.loop))
        return self._bells[-1]

    def busy(self) -> threading.Event:
        """Keeps the loop's thread busy until that is set."""
        gate, busy = threading.Event(), threading.Event()

        def keep_busy() -> None:
            busy.set()
            gate.wait(PATIENCE_S)

        self.loop.call_later(0.0, keep_busy)
        assert busy.wait(PATIENCE_S)
        return gate

    def close(self) -> None:
        self.loop.stop(lambda: None)
        for bell in self._bells:
            bell.close()


def in_loop(loop: Loop, function: Callable[[], None]) -> None:
    """Runs something in the loop's thread, and waits for it."""
    done = threading.Event()
    loop.call_later(0.0, function)
    loop.call_later(0.0, done.set)
    assert done.wait(PATIENCE_S)


@pytest.fixture
def rig() -> Iterator[Rig]:
    with no_thread_left():
        made = Rig(Clock(step_s=0.001))
        yield made
        made.close()


def relieved(guest: Visitor) -> None:
    """What a turn sees that holds its thread so long that another one takes over."""
    guest.stays = False
    guest.relieve()


def test_a_thread_that_was_relieved_ends_and_another_goes_on(rig: Rig) -> None:
    rig.lend()
    first, second = rig.bell(), rig.bell()
    first.ring()
    assert first.heard.acquire(timeout=PATIENCE_S)
    gate = rig.busy()  # else it could happen in the visit that only wakes the loop
    rig.guests[0].during = relieved
    first.ring()
    second.ring()
    gate.set()
    for bell in (first, second):
        assert bell.heard.acquire(timeout=PATIENCE_S)
    before = first.threads[0]
    before.join(PATIENCE_S)
    assert not before.is_alive(), "two threads are in one loop"
    # It was ready together with the first, and is not lost; the thread that was relieved serves it no more.
    served = [bell.threads[-1] for bell in (first, second)]
    assert len(rig.guests) == 2 and served.count(before) == 1
    in_loop(rig.loop, lambda: None)
    second.ring()
    assert second.heard.acquire(timeout=PATIENCE_S)
    assert second.threads[-1] is not before


def test_what_fails_between_two_turns_ends_nothing(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.lend()
    bell = rig.bell()
    bell.ring()
    assert bell.heard.acquire(timeout=PATIENCE_S)

    def fail() -> None:
        raise ZeroDivisionError

    rig.guests[0].leaves = fail
    bell.ring()
    assert bell.heard.acquire(timeout=PATIENCE_S)
    in_loop(rig.loop, lambda: None)
    assert "a handler of the network failed" in caplog.text


def test_however_often_it_is_woken_while_it_is_busy_nobody_has_to_wait(rig: Rig) -> None:
    """What wakes it is read only when it comes to it; there is no room for more than some hundred."""
    gate = rig.busy()
    calls: list[int] = []
    for number in range(2000):
        rig.loop.call_later(100.0 - number / 50, partial(calls.append, number))
    gate.set()
    in_loop(rig.loop, lambda: None)
    assert calls == []


def test_nothing_is_run_after_the_end() -> None:
    with no_thread_left():
        rig = Rig(Clock())
        calls: list[str] = []
        bell, gate, busy = rig.bell(), threading.Event(), threading.Event()

        def keep_busy() -> None:
            busy.set()
            gate.wait(PATIENCE_S)

        bell.hears = keep_busy
        bell.ring()
        assert busy.wait(PATIENCE_S)
        rig.loop.call_later(1.0, lambda: calls.append("after the end"))
        stopping = threading.Thread(target=lambda: rig.loop.stop(lambda: calls.append("the last")))
        stopping.start()
        until_it_stops(rig.loop)
        rig.clock.now_s = 2.0
        gate.set()
        stopping.join(PATIENCE_S)
        assert rig.loop.call_later(0.0, lambda: calls.append("too late")).function is None
        bell.close()
    assert calls == ["the last"]


def until_it_stops(loop: Loop) -> None:
    """Waits until a stop has begun."""
    moment = threading.Event()
    while not loop.stopping:
        moment.wait(0.001)


def test_a_stop_waits_for_the_thread_that_takes_over_later() -> None:
    with no_thread_left():
        rig = Rig(Clock(step_s=0.001))
        rig.lend()
        bell = rig.bell()
        bell.ring()
        assert bell.heard.acquire(timeout=PATIENCE_S)
        gate = rig.busy()
        rig.guests[0].during = lambda guest: setattr(guest, "stays", False)
        bell.ring()
        gate.set()
        bell.threads[0].join(PATIENCE_S)
        ended: list[str] = []

        def stop() -> None:
            rig.loop.stop(lambda: ended.append("the last"))
            ended.append("stopped")

        stopping = threading.Thread(target=stop)
        stopping.start()
        until_it_stops(rig.loop)
        stopping.join(0.05)  # as long as one needs that does not wait
        rig.guests[0].relieve()
        stopping.join(PATIENCE_S)
        bell.close()
    assert ended == ["the last", "stopped"]


def test_a_socket_with_the_number_of_one_that_was_forgotten_is_served(rig: Rig) -> None:
    first = rig.bell()
    in_loop(rig.loop, first.forget)
    first.close()
    second = rig.bell()
    second.ring()
    assert second.heard.acquire(timeout=PATIENCE_S)


def test_a_handler_that_fails_ends_no_other(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    bell = rig.bell()

    def fail() -> None:
        raise ZeroDivisionError

    bell.hears = fail
    bell.ring()
    in_loop(rig.loop, lambda: None)
    in_loop(rig.loop, lambda: None)
    assert "a handler of the network failed" in caplog.text


def test_of_two_calls_the_earlier_comes_first_and_one_that_is_called_off_does_not(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[int] = []
    gate = rig.busy()
    rig.loop.call_later(0.02, lambda: calls.append(2))
    rig.loop.call_later(0.01, lambda: calls.append(1))
    rig.loop.call_later(0.005, lambda: calls.append(0)).cancel()
    gate.set()
    done = threading.Event()
    rig.loop.call_later(0.05, done.set)
    assert done.wait(PATIENCE_S)
    assert calls == [1, 2]
    assert caplog.records == []
