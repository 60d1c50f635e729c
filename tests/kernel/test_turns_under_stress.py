"""Publishers, ticks, guests and held handlers all at once: everything comes, in order, once, one turn at a time.

Then single interleavings, and what may happen in the middle of a turn.
"""

import random
import sys
import threading

import pytest

from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import every, on, reliable
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.timer import TaskTimer
from pancakes.packet import Packet
from pancakes.testing import no_thread_left

PATIENCE_S = 20.0
PACKETS = 400
PUBLISHERS = 3
TICKS = 15


@pytest.fixture
def unruly():
    """Threads change places as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


class Reading(ActorCore):
    """Reads what all publish and is ticked, and holds its thread now and then, about as long as the watchdog waits."""

    def __init__(self, *args):
        super().__init__(*args)
        self.heard = {}
        self.deadlines = []
        self.faults = []
        self.done = threading.Event()
        self._inside = 0
        self._draws = random.Random(self.name)

    @on("system", LogLine, queue=1_000_000)
    def hear(self, packet):
        self._enter()
        if int(packet.body.text) != self.heard.get(packet.source, 0) + 1:
            self.faults.append(f"{packet.body.text} of {packet.source} after {self.heard.get(packet.source)}")
        self.heard[packet.source] = int(packet.body.text)
        self._leave(0.002)

    @every(hz=50)
    def tick(self, tick):
        self._enter()
        self.deadlines.append((tick.time_s, tick.missed))
        self._leave(0.05)

    def _enter(self):
        self._inside += 1
        if self._inside != 1:
            self.faults.append("two turns at once")

    def _leave(self, hold):
        if self._draws.random() < hold:
            threading.Event().wait(self._draws.choice((0.001, 0.0195, 0.0205, 0.04)))
        self._inside -= 1
        if len(self.deadlines) >= TICKS and sum(self.heard.values()) == PACKETS * (PUBLISHERS + 1):
            self.done.set()


def test_nothing_is_lost_doubled_or_out_of_order_however_threads_interleave(unruly):
    with no_thread_left():
        kernel = Kernel("a")
        readers = [kernel.spawn(Reading, f"a/client/R{number}") for number in range(8)]
        for reader in readers:
            reader.actor_ref.proxy().heard.get(timeout=PATIENCE_S)

        def publish(number):
            source = ActorCore(kernel, f"a/client/Source{number}")
            for count in range(1, PACKETS + 1):
                source.publish("system", LogLine("info", str(count)))

        def take_over():
            threads.append(threading.Thread(target=visit))
            threads[-1].start()

        def visit():
            """A guest like the network's thread, with as many successors as it takes."""
            guest = kernel.guest(take_over)
            while guest.stays and counts:
                here = guest.arrive()
                guest_source.publish("system", LogLine("info", str(counts.pop())))
                if here:
                    guest.work(kernel.host.now() + 0.002)
                    guest.leave()

        counts = list(range(PACKETS, 0, -1))
        guest_source = ActorCore(kernel, "a/client/Net")
        threads = [threading.Thread(target=publish, args=(number,)) for number in range(PUBLISHERS)]
        threads.append(threading.Thread(target=visit))
        for thread in list(threads):
            thread.start()
        for reader in readers:
            assert reader.done.wait(PATIENCE_S), f"{reader.name} has only {reader.heard}, {len(reader.deadlines)} ticks"
        for thread in threads:
            thread.join(PATIENCE_S)
        for reader in readers:
            reader.actor_ref.stop(timeout=PATIENCE_S)
        kernel.stop()
    for reader in readers:
        assert reader.faults == []
        times_s = [time_s for time_s, _ in reader.deadlines]
        assert times_s == sorted(set(times_s)), "a tick came twice, or out of order"
        gaps = zip(reader.deadlines, reader.deadlines[1:], strict=False)
        assert all(round((after_s - before_s) * 50) >= 1 for (before_s, _), (after_s, _) in gaps)


def test_a_tick_that_comes_while_the_one_before_is_taken_comes_once():
    """The turn takes the waiting tick while the timer's thread is about to replace it."""
    ticks = []

    class Ticked(ActorCore):
        def tick(self, tick):
            ticks.append((tick.time_s, tick.missed))

    class Interrupted(TaskTimer):
        """Lets the turn happen right after its deadline was set."""

        now = False

        @property
        def deadline_s(self):
            return self.kept_s

        @deadline_s.setter
        def deadline_s(self, deadline_s):
            self.kept_s = deadline_s
            if self.now:
                self.now = False
                self.run()

    with no_thread_left():
        kernel = Kernel("a")
        component = Ticked(kernel, "a/client/T")
        timer = Interrupted(component, "tick", Ticked.tick, 0.1, kernel)
        timer.fire(0.1, 0)
        timer.now = True
        for deadline_s in (0.2, 0.3):
            timer.fire(deadline_s, 0)
            if timer.pending:
                timer.run()
        kernel.stop()
    assert [time_s for time_s, _ in ticks] == sorted({time_s for time_s, _ in ticks})
    assert len(ticks) + sum(missed for _, missed in ticks) == 3


@pytest.mark.parametrize("with_guest", [True, False], ids=["with a guest", "with workers only"])
def test_no_packet_is_forgotten_though_no_watchdog_looks(unruly, pools, with_guest):
    """A worker that lies down, or a guest that leaves, just when something comes."""

    class Echo(ActorCore):
        def __init__(self, *args):
            super().__init__(*args)
            self.heard = threading.Semaphore(0)

        @on("system", LogLine)
        def hear(self, packet):
            self.heard.release()

    with no_thread_left():
        kernel = Kernel("a")
        pools[0].looks = lambda: 0
        echo = kernel.spawn(Echo, "a/client/Echo")
        echo.actor_ref.proxy().heard.get(timeout=PATIENCE_S)
        source = ActorCore(kernel, "a/client/Source")
        ended = threading.Event()

        def visit():
            guest = kernel.guest(lambda: None)
            while with_guest and not ended.is_set():
                if guest.arrive():
                    guest.leave()

        visitor = threading.Thread(target=visit)
        visitor.start()
        try:
            for number in range(1500):
                source.publish("system", LogLine("info", "on you go"))
                assert echo.heard.acquire(timeout=PATIENCE_S), f"packet {number} was forgotten"
        finally:
            ended.set()
            visitor.join(PATIENCE_S)
            echo.stop()
            kernel.stop()


@pytest.fixture
def kernel():
    with no_thread_left():
        made = Kernel("a")
        yield made
        for component in made.registry.components():
            component.actor_ref.stop(timeout=PATIENCE_S)
        made.stop()


class Minded(ActorCore):
    """Does with the first packet what a test has in mind."""

    idea = staticmethod(lambda component, packet: None)

    def __init__(self, *args):
        super().__init__(*args)
        self.heard = []

    @on("system", LogLine, queue=reliable(8))
    def hear(self, packet):
        self.heard.append(packet.body.text)
        if packet.body.text == "one":
            self.idea(self, packet)

    @on("ctrl", LogLine, queue=reliable(8))
    def hear_alone(self, packet):
        self.hear(packet)


def minded(kernel, idea, *texts, second="system"):
    """Returns an actor to which some packets come at once, once it has had a turn with them."""
    component = kernel.spawn(Minded, "a/client/M")
    component.idea = idea
    done, ended = threading.Event(), threading.Event()
    component.exited = lambda it, error: ended.set()
    source = ActorCore(kernel, "a/client/Source")

    def all_at_once():
        for number, text in enumerate(texts or ("one", "two")):
            source.publish(second if number else "system", LogLine("info", text))

    component.call(all_at_once)
    component.call(lambda: component.call(done.set))
    for _ in range(int(PATIENCE_S * 100)):
        if ended.is_set() or done.wait(0.01):
            return component
    raise AssertionError("it has had no turn")


@pytest.mark.parametrize("second", ["system", "ctrl"])
def test_an_actor_that_stops_in_the_middle_of_its_packets_gets_no_more_of_them(kernel, second):
    component = minded(kernel, lambda it, packet: it.stop(), second=second)
    assert component.heard == ["one"]
    assert [it.body.text for it in component.actor_inbox.queues[second].drain()] == ["two"]


@pytest.mark.parametrize("second", ["system", "ctrl"])
def test_an_actor_that_stands_still_in_the_middle_of_its_packets_gets_the_others_later(kernel, second):
    component = minded(kernel, lambda it, packet: it.pause(), second=second)
    assert component.heard == ["one"]
    resumed = threading.Event()
    component.call(lambda: (component.resume(), component.call(resumed.set)))
    assert resumed.wait(PATIENCE_S)
    assert component.heard == ["one", "two"]


@pytest.mark.parametrize("second", ["system", "ctrl"])
def test_a_call_that_fails_between_two_packets_brings_neither_back(kernel, second):
    component = minded(kernel, lambda it, packet: it.call(lambda: 1 / 0), second=second)
    assert component.heard == ["one"]
    queues = component.actor_inbox.queues.values()
    assert [it.body.text for waiting in queues for it in waiting.drain()] == ["two"]
    assert kernel.dead_letters.count == 0


def test_what_is_published_again_and_again_has_its_cause_as_the_first_time_and_none_after_the_turn(kernel):
    published: list[Packet] = []

    def idea(it, packet):
        it.fence = "a fence"
        published.extend(it.publish("log", LogLine("info", "said")) for _ in range(2))

    component = minded(kernel, idea, "one")
    said = threading.Event()

    def publish():
        published.append(component.publish("log", LogLine("info", "said")))
        said.set()

    component.call(publish)
    assert said.wait(PATIENCE_S)
    first, second, after = published
    assert first.cause == second.cause == ("a/client/Source", 1)
    assert after.cause is None
    assert {packet.fence for packet in published} == {"a fence"}


@pytest.mark.parametrize("second", ["system", "ctrl"])
def test_what_a_turn_has_handled_is_neither_counted_as_dropped_nor_weighed_any_more(kernel, second):
    component = minded(kernel, lambda it, packet: None, "one", "x" * 5000, second=second)
    queues = component.actor_inbox.queues.values()
    assert len(component.heard) == sum(waiting.handled for waiting in queues) == 2
    assert [(waiting.dropped(), waiting.heavy_bytes) for waiting in queues] == [(0, 0)] * 2


def test_a_stream_that_was_silenced_takes_nothing_from_earlier_publishers_either(kernel):
    component = minded(kernel, lambda it, packet: None)
    source = ActorCore(kernel, "a/client/Other")
    for text in ("three", "four"):
        source.publish("system", LogLine("info", text))
    kernel.stream.silence()
    source.publish("system", LogLine("info", "five"))
    handled = threading.Event()
    component.call(lambda: component.call(handled.set))  # what waits is handled between the two
    assert handled.wait(PATIENCE_S)
    assert component.heard == ["one", "two", "three", "four"]
