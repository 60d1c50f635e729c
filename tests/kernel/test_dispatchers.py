"""The dispatchers: where each component runs, and that none stops the rest."""

import math
import random
import threading
from collections.abc import Callable
from queue import SimpleQueue

import pytest

from pancakes.errors import PancakesError
from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.dispatchers import PinnedDispatcher
from pancakes.kernel.handlers import on
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.pykka_actor import Flag
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.testing import Probe, VirtualClock, assert_published, no_thread_left

PATIENCE_S = 10.0


class Echo(ActorCore):
    """Remembers the threads that ran it, and what it heard."""

    def __init__(self, *args, gate=None, **others):
        super().__init__(*args, **others)
        self.threads = set()
        self.heard = []
        self.gate = gate
        self.reached = threading.Event()
        self.ended = threading.Event()

    def on_start(self):
        self.exited = lambda component, error: self.ended.set()

    @on("system", LogLine)
    def hear(self, packet):
        self.threads.add(threading.current_thread().name)
        self.heard.append(packet.body.text)
        self.reached.set()
        if self.gate is not None:
            assert self.gate.wait(PATIENCE_S)


class Pinned(Echo):
    blocking = True


class Quitting(Echo):
    def hear(self, packet):
        raise SystemExit(3)

    hear = on("system", LogLine)(hear)


class Failing(Echo):
    @on("system", LogLine)
    def hear(self, packet):
        raise RuntimeError("as it must")


def ready(component):
    """Waits until an actor has done what it was asked before."""
    component.actor_ref.proxy().heard.get(timeout=PATIENCE_S)
    return component


def test_one_worker_serves_many_actors(kernel):
    echoes = [ready(kernel.spawn(Echo, f"a/client/E{number}")) for number in range(200)]
    source = kernel.spawn(Echo, "a/client/Source")
    for text in ("one", "two", "three"):
        source.publish("system", LogLine("info", text))
    for echo in echoes:
        wait_until_heard(echo, 3)
        assert echo.heard == ["one", "two", "three"]
    pool = [thread.name for thread in threading.enumerate() if thread.name.startswith("a-pool-")]
    assert len(pool) <= 4  # one at work, one standing by, the watchdog; one more where the machine made it wait


def test_handlers_that_wait_do_not_stop_the_rest_and_are_named(kernel):
    probe = kernel.spawn(Probe, "a/test/Probe", channels=("log",))
    gate = threading.Event()
    stuck = [ready(kernel.spawn(Echo, f"a/client/Stuck{number}", gate=gate)) for number in range(5)]
    free = ready(kernel.spawn(Echo, "a/client/Free"))
    source = kernel.spawn(Echo, "a/client/Source")
    try:
        source.publish("system", LogLine("info", "one"))
        assert free.reached.wait(PATIENCE_S), "five handlers that wait have stopped a sixth"
        assert probe.wait(
            lambda: all(
                any(f"Stuck{number} has held" in line.body.text for line in probe.packets(LogLine))
                for number in range(5)
            ),
            PATIENCE_S,
        )
    finally:
        gate.set()
    named = assert_published(probe, LogLine, lambda line: "Stuck0" in line.text)
    assert "blocking = True" in named.body.text
    assert all(echo.reached.is_set() for echo in stuck)


def test_the_root_is_not_named_for_holding_a_thread(pools, kernel):
    probe = kernel.spawn(Probe, "a/test/Probe", channels=("log",))
    assert probe.wait(probe.listening, PATIENCE_S)
    pools[0].name_held(kernel.spawn(Echo, "a/kernel"), 0.1)
    pools[0].name_held(kernel.spawn(Echo, "a/client/T"), 0.1)
    assert probe.wait(lambda: probe.packets(LogLine), PATIENCE_S)
    assert ["a/client/T has held" in packet.body.text for packet in probe.packets(LogLine)] == [True]


def test_a_component_of_pancakes_gets_no_advice_that_its_author_alone_could_follow(pools, kernel):
    probe = kernel.spawn(Probe, "a/test/Probe", channels=("log",))
    assert probe.wait(probe.listening, PATIENCE_S)
    pools[0].name_held(probe, 0.123)
    said = (
        "a/test/Probe has held a thread of the pool for 123 ms:"
        " a task's class, state, cost or rule takes long there, or this computer is busy"
    )
    assert_published(probe, LogLine, lambda line: (line.level, line.text) == ("info", said))


def wait_until_heard(echo, count):
    """Waits until an actor has heard so many lines; each look is a message that it answers after those before it."""
    while len(ready(echo).heard) < count:
        pass


@pytest.mark.parametrize("bad", [Failing, Quitting])
def test_an_actor_that_fails_ends_alone(kernel, bad):
    failing = ready(kernel.spawn(bad, "a/client/Bad"))
    ended = threading.Event()
    errors = []

    def exited(component, error):
        errors.append(error)
        ended.set()

    failing.exited = exited
    pinned = ready(kernel.spawn(Pinned, "a/client/Pinned"))
    echo = ready(kernel.spawn(Echo, "a/client/Echo"))
    source = kernel.spawn(Echo, "a/client/Source")
    source.publish("system", LogLine("info", "one"))
    assert ended.wait(PATIENCE_S)
    source.publish("system", LogLine("info", "two"))
    for other in (pinned, echo):
        wait_until_heard(other, 2)
    assert not failing.actor_ref.is_alive()
    assert type(errors[0]) in (RuntimeError, SystemExit)
    assert kernel.registry.get("a/client/Bad") is None


def test_a_blocking_actor_has_a_thread_of_its_own_that_ends_with_it(kernel):
    gate = threading.Event()
    pinned = ready(kernel.spawn(Pinned, "a/client/Pinned", gate=gate))
    source = kernel.spawn(Echo, "a/client/Source")
    source.publish("system", LogLine("info", "one"))
    assert pinned.reached.wait(PATIENCE_S)
    (thread,) = [thread for thread in threading.enumerate() if thread.name == "a-Pinned"]
    gate.set()
    pinned.actor_ref.stop(timeout=PATIENCE_S)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert pinned.threads == {"a-Pinned"}


def test_packets_to_an_actor_keep_their_order_however_many_threads_publish(kernel):
    echo = ready(kernel.spawn(Echo, "a/client/Echo"))
    sources = [kernel.spawn(Echo, f"a/client/S{number}") for number in range(4)]

    def publish(source, number):
        for count in range(60):
            source.publish("system", LogLine("info", f"{number}.{count}"))

    threads = [threading.Thread(target=publish, args=(source, number)) for number, source in enumerate(sources)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wait_until_heard(echo, 240)
    for number in range(4):
        assert [text for text in echo.heard if text.startswith(f"{number}.")] == [f"{number}.{c}" for c in range(60)]


# Virtual time --------------------------------------------------------------------------------------------------


def order_of_work(seed, actors=20):
    """Returns the order in which so many actors get their turns."""
    dispatcher = VirtualDispatcher(seed)
    kernel = Kernel("a", virtual=dispatcher)
    served = []

    class Served(ActorCore):
        @on("system", LogLine)
        def hear(self, packet):
            served.append(self.name)

    for number in range(actors):
        kernel.spawn(Served, f"a/client/{number}")
    dispatcher.settle()
    kernel.say(LogLine("info", "on log, which has no reader"))
    source = kernel.spawn(ActorCore, "a/client/Source")
    dispatcher.settle()
    source.publish("system", LogLine("info", "go"))
    dispatcher.settle()
    return served


def test_in_virtual_time_a_seed_draws_the_order():
    assert sorted(order_of_work(1), key=int) == [str(number) for number in range(20)]
    assert order_of_work(1) == order_of_work(1)
    assert len({tuple(order_of_work(seed)) for seed in range(20)}) == 20
    assert len({tuple(order_of_work(seed, actors=2)) for seed in range(20)}) == 2


def test_virtual_time_moves_only_when_no_component_has_anything_to_do():
    dispatcher = VirtualDispatcher(1)
    times = []

    def again(left):
        times.append(dispatcher.clock.now())
        if left:
            dispatcher.call_at(dispatcher.clock.now() + 2.0, lambda: again(left - 1))

    dispatcher.call_at(1.0, lambda: again(3))
    dispatcher.run_until(4.0)
    assert times == [1.0, 3.0]
    assert dispatcher.clock.now() == 4.0
    assert dispatcher.run_until(100.0, lambda: len(times) == 4)
    assert times == [1.0, 3.0, 5.0, 7.0]
    assert not dispatcher.run_until(100.0)
    assert dispatcher.clock.now() == 100.0
    assert not dispatcher.step()


def test_a_call_for_a_time_that_has_passed_comes_now():
    dispatcher = VirtualDispatcher(1)
    dispatcher.run_until(5.0)
    times = []
    dispatcher.call_at(1.0, lambda: times.append(dispatcher.clock.now()))
    dispatcher.call_at(2.0, lambda: times.append(2.0)).cancel()
    dispatcher.run_until(6.0)
    assert times == [5.0]


def test_a_call_for_the_end_of_all_time_never_comes():
    dispatcher = VirtualDispatcher(1)
    called = []
    dispatcher.call_at(math.inf, lambda: called.append("never")).cancel()
    dispatcher.call_at(math.inf, lambda: called.append("never"))
    assert dispatcher.next_s() == math.inf
    assert not dispatcher.step()
    assert (called, dispatcher.clock.now()) == ([], 0.0)


def test_calls_come_in_the_order_of_their_times_and_those_of_one_time_as_they_were_asked_for():
    dispatcher, source = VirtualDispatcher(1), random.Random(7)
    asked: list[tuple[float, int, bool]] = []
    came: list[tuple[float, int]] = []

    def ask(depth):
        # Some far away, most so soon that they need no heap, many for one and the same time.
        delay_s = source.choice((0.0, 0.0005, 0.0005, 0.0008, 0.0015, 0.5))
        time_s, number = round(dispatcher.clock.now() + delay_s, 4), len(asked)
        call = dispatcher.call_at(time_s, lambda: come(time_s, number, depth))
        if source.random() < 0.2:
            call.cancel()
        asked.append((time_s, number, call.function is not None))

    def come(time_s, number, depth):
        assert dispatcher.clock.now() == time_s
        came.append((time_s, number))
        if depth:
            ask(depth - 1)
            ask(depth - 1)

    for _ in range(30):
        ask(6)
    dispatcher.run_until(10.0)
    assert len(came) > 200
    assert came == sorted((time_s, number) for time_s, number, wanted in asked if wanted)


def test_a_virtual_clock_never_goes_back():
    clock = VirtualClock(3.0)
    clock.advance_to(4.0)
    with pytest.raises(ValueError, match="cannot go back"):
        clock.advance_to(3.5)


class Restless(ActorCore):
    """Tells itself to go on, for ever."""

    def on_start(self):
        self.call(self.on_start)


def test_an_endless_loop_at_one_moment_is_named_and_does_not_hang(monkeypatch):
    monkeypatch.setattr("pancakes.kernel.virtual_time.MOST_TURNS", 1000)
    dispatcher = VirtualDispatcher()
    Kernel("a", virtual=dispatcher).spawn(Restless, "a/test")
    with pytest.raises(PancakesError, match="does not get past 0.0 s: after 1000 turns a/test still has work"):
        dispatcher.settle()


def test_a_call_that_was_called_off_is_nothing_that_happens_next():
    dispatcher = VirtualDispatcher(1)
    first, second = dispatcher.call_at(1.0, lambda: None), dispatcher.call_at(2.0, lambda: None)
    assert dispatcher.next_s() == 1.0
    first.cancel()
    assert dispatcher.next_s() == 2.0
    second.cancel()
    assert dispatcher.next_s() == math.inf


class Runner:
    """Gets turns on a thread of its own, and notes them."""

    address = "a/client/Runner"
    blocking = True
    author_class = object
    facade = None
    loop = None

    def __init__(self, mailbox: Mailbox, turn: Callable[[], object]) -> None:
        self.actor_inbox = mailbox
        self.actor_stopped = Flag()
        self.turn = turn

    def acts(self) -> bool:
        return True

    def may_await(self) -> bool:
        return False

    def take_turn(self, slice_s: float | None) -> None:
        self.turn()


def test_a_blocking_actor_is_woken_though_the_thread_before_it_ends_only_now() -> None:
    """A task that starts again has the mailbox of the one before it."""
    with no_thread_left():
        dispatcher, mailbox = PinnedDispatcher("a"), Mailbox()
        turns: SimpleQueue[None] = SimpleQueue()
        second = Runner(mailbox, lambda: turns.put(None))

        def last_turn() -> None:
            dispatcher.attach(second)
            first.actor_stopped.set()
            threads.append(threading.current_thread())
            turns.put(None)

        threads: list[threading.Thread] = []
        first = Runner(mailbox, last_turn)
        dispatcher.attach(first)
        for _ in range(2):  # the last of the first one, and the first of the second one
            turns.get(timeout=PATIENCE_S)
        threads[0].join(PATIENCE_S)
        dispatcher.ready(mailbox)
        turns.get(timeout=PATIENCE_S)
        dispatcher.stop()


def test_a_blocking_actor_that_does_not_come_back_does_not_keep_the_process() -> None:
    with no_thread_left():
        dispatcher = PinnedDispatcher("a")
        daemons: SimpleQueue[bool] = SimpleQueue()
        dispatcher.attach(Runner(Mailbox(), lambda: daemons.put(threading.current_thread().daemon)))
        is_daemon = daemons.get(timeout=PATIENCE_S)
        dispatcher.stop()
    assert is_daemon
