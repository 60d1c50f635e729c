"""Guests of the pool: threads that do the work that they bring, and lose nothing where it holds them."""

import math
import threading
from typing import Any

import pytest
from kernel.hooked_pool import HookedPool

from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.dispatchers import DOZE_LOOKS, WATCH_S, Guest, PoolDispatcher, defer
from pancakes.kernel.handlers import every, on
from pancakes.kernel.kernel import Kernel
from pancakes.testing import no_thread_left
from pancakes.util.clock import MonotonicClock

PATIENCE_S = 10.0


class Hearing(ActorCore):
    """Notes in which thread it heard what."""

    gate = None
    deferred = None

    def __init__(self, *args):
        super().__init__(*args)
        self.heard = []
        self.threads = []
        self.news = threading.Event()

    @on("system", LogLine)
    def hear(self, packet):
        self.heard.append(packet.body.text)
        self.threads.append(threading.current_thread())
        if self.deferred is not None:
            defer(self.deferred)
        self.news.set()
        if self.gate is not None:
            assert self.gate.wait(PATIENCE_S)


class Ticked(ActorCore):
    """Is ticked, and is held by its first tick where it has a gate."""

    gate: threading.Event | None = None

    def __init__(self, *args):
        super().__init__(*args)
        self.deadlines = []
        self.held = threading.Event()
        self.news = threading.Condition()

    @every(hz=100)
    def tick(self, tick):
        if self.gate is not None and not self.held.is_set():
            self.held.set()
            assert self.gate.wait(PATIENCE_S)
        with self.news:
            self.deadlines.append((tick.time_s, tick.missed))
            self.news.notify_all()

    def wait(self, count):
        with self.news:
            assert self.news.wait_for(lambda: len(self.deadlines) >= count, PATIENCE_S), f"{self.address} is not ticked"


def ready(component):
    """Waits until an actor has started."""
    component.actor_ref.proxy().heard.get(timeout=PATIENCE_S)
    return component


def arrived(guest):
    """Waits until a guest may work: until no worker is at it any more."""
    until = threading.Event()
    for _ in range(2000):
        if guest.arrive():
            return guest
        until.wait(0.001)
    raise AssertionError("the pool is never at rest")


def test_a_guest_gives_the_turns_that_it_has_caused_in_its_own_thread(kernel):
    hearing = ready(kernel.spawn(Hearing, "a/client/H"))
    guest = arrived(kernel.guest(lambda: None))
    kernel.log("info", "without a reader")
    source = ActorCore(kernel, "a/client/Source")
    source.publish("system", LogLine("info", "one"))
    assert hearing.heard == [], "its turn comes when the guest says so"
    guest.work(math.inf)
    assert hearing.heard == ["one"]
    assert hearing.threads == [threading.current_thread()]
    guest.leave()


def test_what_a_guest_does_not_come_to_a_worker_does(pools, kernel):
    hearing = ready(kernel.spawn(Hearing, "a/client/H"))
    pools[0].looks = lambda: 0  # at once, not because the watchdog looks
    guest = arrived(kernel.guest(lambda: None))
    ActorCore(kernel, "a/client/Source").publish("system", LogLine("info", "one"))
    guest.leave()
    assert hearing.news.wait(PATIENCE_S)
    assert hearing.threads[0].name.startswith("a-pool-")


def test_there_is_one_at_work_at_a_time(kernel):
    first, second = arrived(kernel.guest(lambda: None)), kernel.guest(lambda: None)
    assert not second.arrive()
    first.leave()
    assert arrived(second) is second
    second.leave()


def test_a_turn_s_end_is_the_turn_s_end_in_a_guest_too(kernel):
    done: list[Any] = []
    hearing = ready(kernel.spawn(Hearing, "a/client/H"))
    hearing.deferred = lambda: done.append(list(hearing.heard))
    guest = arrived(kernel.guest(lambda: None))
    ActorCore(kernel, "a/client/Source").publish("system", LogLine("info", "one"))
    guest.work(math.inf)
    assert done == [["one"]]
    defer(lambda: done.append("between turns"))
    assert done == [["one"], "between turns"]
    guest.leave()


def test_a_guest_that_is_held_is_relieved_once_and_the_others_go_on():
    relieved = []
    news = threading.Event()
    gate = threading.Event()
    with no_thread_left():
        kernel = Kernel("a")
        stuck, free = ready(kernel.spawn(Hearing, "a/client/Stuck")), ready(kernel.spawn(Hearing, "a/client/Free"))
        stuck.gate = gate
        source = ActorCore(kernel, "a/client/Source")

        def relieve():
            relieved.append(True)
            news.set()

        def visit():
            guest = arrived(kernel.guest(relieve))
            source.publish("system", LogLine("info", "one"))
            guest.work(math.inf)
            relieved.append(guest.stays)
            guest.leave()

        visitor = threading.Thread(target=visit)
        visitor.start()
        assert news.wait(PATIENCE_S), "no thread took the duties of a guest over that is held"
        assert free.news.wait(PATIENCE_S), "a guest that is held has stopped another"
        gate.set()
        visitor.join(PATIENCE_S)
        assert relieved == [True, False]
        for component in (free, stuck):
            component.actor_ref.stop(timeout=PATIENCE_S)
        kernel.stop()


def test_a_handler_that_holds_the_timer_s_thread_stops_no_ticks(kernel, caplog):
    class Held(Ticked):
        gate = threading.Event()

    gate = Held.gate

    held = kernel.spawn(Held, "a/client/Held")
    others = [kernel.spawn(Ticked, f"a/client/T{number}") for number in range(5)]
    try:
        assert held.held.wait(PATIENCE_S)
        for other in others:
            other.wait(len(other.deadlines) + 20)
    finally:
        gate.set()
    held.wait(3)
    for ticked in (held, *others):
        deadlines = list(ticked.deadlines)
        times_s = [time_s for time_s, _ in deadlines]
        assert times_s == sorted(set(times_s)), "a tick came twice, or out of order"
        # Each deadline since the first came, or was counted as missed by the next that came.
        for (before_s, _), (after_s, missed) in zip(deadlines, deadlines[1:], strict=False):
            assert round((after_s - before_s) * 100) == 1 + missed
    assert caplog.records == [], "the thread that was held has disturbed the one that took over"


def test_the_watchdog_rests_while_no_thread_works_and_wakes_when_one_does():
    class Counting(MonotonicClock):
        """Counts how often it is asked for the time."""

        def __init__(self):
            self.asked = threading.Semaphore(0)

        def now(self):
            self.asked.release()
            return MonotonicClock.now()

    clock = Counting()
    with no_thread_left():
        pool = PoolDispatcher("p", clock)
        looked = 0
        while clock.asked.acquire(timeout=0.5):
            looked += 1
            assert looked < 1000, "the watchdog never rests"
        guest = Guest(pool, lambda: None)
        assert guest.arrive()
        assert clock.asked.acquire(timeout=PATIENCE_S), "the watchdog does not watch the guest"
        guest.leave()
        pool.stop()


def held_visit(kernel, hearing, before_turn=lambda: None):
    """Lets a guest arrive in a thread of its own and give one turn, to `hearing`, which has a gate."""

    def visit():
        guest = arrived(kernel.guest(lambda: None))
        before_turn()
        ActorCore(kernel, "a/client/Source").publish("system", LogLine("info", "one"))
        guest.work(math.inf)
        guest.leave()

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert hearing.news.wait(PATIENCE_S)
    return visitor


def test_a_guest_that_comes_back_just_now_is_not_relieved(pools, kernel):
    """Else two threads would run its loop."""
    relieved = []
    back, tried = threading.Event(), threading.Event()
    hearing = ready(kernel.spawn(Hearing, "a/client/H"))
    hearing.gate = threading.Event()

    def too_late(hold):
        hearing.gate.set()
        assert back.wait(PATIENCE_S)
        hold()
        tried.set()

    pools[0].around_hold = too_late
    guest = arrived(kernel.guest(lambda: relieved.append("relieved")))
    ActorCore(kernel, "a/client/Source").publish("system", LogLine("info", "one"))
    guest.work(math.inf)
    back.set()
    assert tried.wait(PATIENCE_S)
    assert guest.stays and relieved == []
    guest.leave()


def test_a_worker_gives_the_turns_that_a_guest_has_no_time_for(kernel):
    """It may be held by what it does between its turns, too."""
    hearing = ready(kernel.spawn(Hearing, "a/client/H"))
    guest = arrived(kernel.guest(lambda: None))
    ActorCore(kernel, "a/client/Source").publish("system", LogLine("info", "one"))
    assert hearing.news.wait(PATIENCE_S), "a guest that gives no turns keeps all components from theirs"
    guest.leave()


def test_a_kernel_stops_while_a_handler_holds_the_timer_s_thread():
    gate, held, stopped = threading.Event(), threading.Event(), threading.Event()

    class Stuck(ActorCore):
        @every(hz=100)
        def tick(self, tick):
            if threading.current_thread().name == "a-timer":
                held.set()
                assert gate.wait(PATIENCE_S)

    with no_thread_left():
        kernel = Kernel("a")
        kernel.spawn(Stuck, "a/client/Stuck")
        assert held.wait(PATIENCE_S)

        def stop():
            kernel.stop()
            stopped.set()

        stopping = threading.Thread(target=stop)
        stopping.start()
        try:
            assert stopped.wait(PATIENCE_S / 2), "the stop waits for the handler"
        finally:
            gate.set()
            stopping.join(PATIENCE_S)


def test_ticks_outlive_a_fault_in_what_is_told_of_an_end(kernel):
    ended = threading.Event()

    class Failing(ActorCore):
        @every(hz=100)
        def tick(self, tick):
            if threading.current_thread().name == "a-timer":
                raise ValueError("a fault of its own")

    def exited(component, error):
        ended.set()
        raise RuntimeError("a fault in a supervisor")

    other = kernel.spawn(Ticked, "a/client/T")
    kernel.spawn(Failing, "a/client/F", exited=exited)
    assert ended.wait(PATIENCE_S)
    other.wait(len(other.deadlines) + 5)


@pytest.mark.parametrize(("quick", "slow"), [(0, 1), (10, 1)])
def test_turns_that_take_long_keep_no_tick_of_the_same_time_waiting(pools, kernel, quick, slow):
    """Components that run elsewhere than in the pool would have to wait for all of them."""
    ticked = []
    fired: list[ActorCore] = []
    both = threading.Event()

    class Slow(ActorCore):
        @every(hz=4)
        def tick(self, tick):
            threading.Event().wait(0.01)
            ticked.append(self)
            if len(ticked) == slow + 1:
                fired.extend(one for one in tasks if one.timers["tick"].pending or one.timers["tick"].ticks)
                both.set()

    class Quick(ActorCore):
        @every(hz=4)
        def tick(self, tick):
            pass

    pools[0].looks = lambda: 0  # however slow the machine, no other thread takes over
    for number in range(quick):
        kernel.spawn(Quick, f"a/client/Quick{number}")
    tasks = [kernel.spawn(Slow, f"a/client/Slow{number}") for number in range(10)]
    assert both.wait(PATIENCE_S)
    assert len(fired) == len(tasks)


def test_the_watchdog_does_not_rest_while_a_handler_holds_a_worker(kernel):
    gate = threading.Event()
    stuck, free = ready(kernel.spawn(Hearing, "a/client/Stuck")), ready(kernel.spawn(Hearing, "a/client/Free"))
    stuck.gate = gate
    source = ActorCore(kernel, "a/client/Source")
    source.publish("system", LogLine("info", "one"), to="a/client/Stuck")
    assert stuck.news.wait(PATIENCE_S)
    assert not gate.wait(2 * DOZE_LOOKS * WATCH_S)
    source.publish("system", LogLine("info", "one"), to="a/client/Free")
    assert free.news.wait(PATIENCE_S / 2), "a handler that has held a worker for long stops another"
    gate.set()


def test_a_pool_ends_while_its_watchdog_rests():
    with no_thread_left():
        pool = HookedPool("p", MonotonicClock())
        moment = threading.Event()
        for _ in range(2000):
            if pool.dozing:
                break
            moment.wait(0.001)
        assert pool.dozing
        stopping = threading.Thread(target=pool.stop, daemon=True)
        stopping.start()
        stopping.join(PATIENCE_S)
        assert not stopping.is_alive()
