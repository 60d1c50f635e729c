"""What an actor may rely on: its turns, its two lanes, its timers, its end, and its successor."""

import math
import random
from dataclasses import dataclass

import pytest
from kernel.actors import put_back
from pykka import ActorDeadError

from pancakes.errors import LocalProtocolError, MailboxFull, UnknownChannel
from pancakes.events import Event, LogLine
from pancakes.kernel.component import Component
from pancakes.kernel.handlers import Tick, every, on
from pancakes.kernel.keep import queue, reliable
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.letters import ATTEMPTS
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.virtual import VirtualDispatcher
from pancakes.packet import packet_type
from pancakes.testing import Probe, assert_published


@packet_type("test_component.number")
@dataclass(frozen=True)
class Number:
    """A packet of these tests."""

    n: int


@packet_type("test_component.word")
@dataclass(frozen=True)
class Word:
    """Another."""

    text: str


class Rig:
    """A kernel in virtual time, with a source of packets."""

    def __init__(self, seed=1, **others):
        self.dispatcher = VirtualDispatcher(seed)
        self.kernel = Kernel("a", virtual=self.dispatcher, **others)
        self.source = self.spawn(Component, "a/client/Source")
        self.probe = self.spawn(Probe, "a/test/Probe", channels=("log",))

    def spawn(self, cls, address, **arguments):
        component = self.kernel.spawn(cls, address, **arguments)
        self.settle()
        return component

    def send(self, *bodies, to="", channel="system"):
        for body in bodies:
            self.source.publish(channel, body, to)

    def settle(self):
        self.dispatcher.settle()

    def run_until(self, time_s):
        self.dispatcher.run_until(time_s)

    def lines(self):
        self.settle()
        return [packet.body.text for packet in self.probe.packets(LogLine)]


@pytest.fixture
def rig():
    return Rig()


class Diary(Component):
    """Writes down whatever happens to it."""

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self.diary = []

    def on_start(self):
        self.diary.append("start")

    def on_stop(self):
        self.diary.append("stop")

    @on("system", Number)
    def number(self, packet):
        self.diary.append(packet.body.n)


def test_a_life_from_start_to_stop(rig):
    diary = rig.spawn(Diary, "a/client/Diary")
    rig.send(Number(1), Number(2))
    rig.settle()
    diary.stop()
    rig.settle()
    rig.send(Number(3))
    rig.settle()
    assert diary.diary == ["start", 1, 2, "stop"]
    assert rig.kernel.stream.subscribers("system") == []
    assert rig.kernel.registry.get("a/client/Diary") is None


def test_two_actors_cannot_share_an_address(rig):
    rig.spawn(Diary, "a/client/Diary")
    with pytest.raises(ValueError, match="a/client/Diary runs already"):
        rig.spawn(Diary, "a/client/Diary")


def test_control_goes_before_data(rig):
    """A stop, a tick or a call does not wait for a hundred packets."""
    diary = rig.spawn(Diary, "a/client/Diary")
    rig.send(*map(Number, range(5)))
    diary.call(lambda: diary.diary.append("call"))
    rig.settle()
    assert diary.diary == ["start", "call", 0, 1, 2, 3, 4]


def test_control_that_comes_in_the_middle_of_data_goes_next(rig):
    class Busy(Diary):
        @on("system", Number)
        def number(self, packet):
            super().number(packet)
            if packet.body.n == 1:
                self.call(lambda: self.diary.append("call"))

    busy = rig.spawn(Busy, "a/client/Busy")
    rig.send(*map(Number, range(4)))
    rig.settle()
    assert busy.diary == ["start", 0, 1, "call", 2, 3]


def test_a_stop_leaves_what_waits(rig):
    diary = rig.spawn(Diary, "a/client/Diary")
    rig.send(*map(Number, range(5)))
    diary.stop()
    rig.settle()
    assert diary.diary == ["start", "stop"]


def test_an_actor_that_stands_still_gets_no_packet_and_no_tick_and_then_all_that_waits(rig):
    class Ticking(Diary):
        @every(period_s=1.0)
        def tick(self, tick):
            self.diary.append(f"tick {tick.time_s:g}")

    diary = rig.spawn(Ticking, "a/client/Diary")
    rig.run_until(1.5)
    diary.call(diary.pause)
    rig.settle()
    rig.send(Number(1), Number(2))
    rig.run_until(4.5)
    assert diary.diary == ["start", "tick 1"]
    diary.call(diary.resume)
    rig.run_until(5.5)
    assert diary.diary == ["start", "tick 1", 1, 2, "tick 5"]


def test_a_packet_tells_where_it_comes_from_and_what_led_to_it(rig):
    class Echo(Component):
        @on("system", Number)
        def number(self, packet):
            self.publish("ctrl", Word(f"after {packet.body.n}"))

    rig.probe.follow("ctrl")
    rig.run_until(2.5)
    rig.spawn(Echo, "a/client/Echo")
    sent = rig.source.publish("system", Number(7))
    rig.settle()
    heard = assert_published(rig.probe, Word, source="a/client/Echo")
    assert heard.cause == (sent.source, sent.seq)
    assert (heard.stamp, heard.seq, heard.destination) == (2.5, 1, "")
    assert sent.cause is None


def test_the_numbers_of_a_source_go_on_with_its_successor(rig):
    diary = rig.spawn(Diary, "a/client/Diary")
    assert [diary.publish("ctrl", Number(1)).seq for _ in range(3)] == [1, 2, 3]
    diary.stop()
    rig.settle()
    successor = rig.spawn(Diary, "a/client/Diary")
    assert successor.publish("ctrl", Number(1)).seq == 4
    # What a snapshot from elsewhere says may be older than what this agent remembers: no number comes twice.
    rig.kernel.continue_seq("a/client/Diary", 2)
    assert rig.kernel.seq_of("a/client/Diary").take() == 5
    rig.kernel.continue_seq("a/client/Diary", 100)
    assert rig.kernel.seq_of("a/client/Diary").take() == 100


def test_what_is_no_packet_type_or_no_channel_is_refused_with_a_sentence(rig):
    with pytest.raises(LocalProtocolError, match="builtins.dict is no packet type"):
        rig.source.publish("system", {})
    with pytest.raises(UnknownChannel, match="published 'test_component.number' to 'maps', but a has no such channel"):
        rig.source.publish("maps", Number(1))


def test_a_slow_reader_that_may_lose_nothing_makes_the_publisher_wait(rig):
    class Careful(Diary):
        @on("system", Number, keep=reliable(2))
        def number(self, packet):
            super().number(packet)

    careful = rig.spawn(Careful, "a/client/Careful")
    rig.send(Number(1), Number(2))
    with pytest.raises(MailboxFull, match="a/client/Careful has no room for 'test_component.number'"):
        rig.send(Number(3))
    rig.settle()
    rig.send(Number(3))
    rig.settle()
    assert careful.diary == ["start", 1, 2, 3]


def test_two_types_on_one_channel_are_handled_in_the_order_in_which_they_were_published(rig):
    class Reader(Diary):
        @on("system", Word)
        def word(self, packet):
            self.diary.append(packet.body.text)

    reader = rig.spawn(Reader, "a/client/Reader")
    rig.send(Number(1), Word("a"), Number(2), Word("b"), Word("c"), Number(3))
    rig.settle()
    assert reader.diary == ["start", 1, "a", 2, "b", "c", 3]


def test_one_method_may_listen_to_several_things_and_several_methods_to_one(rig):
    class Reader(Diary):
        @on("ctrl", Number)
        @on("system", Number)
        def number(self, packet):
            self.diary.append(f"{packet.channel} {packet.body.n}")

        @on("system")
        def anything(self, packet):
            self.diary.append(f"any {packet.type.rpartition('.')[2]}")

    reader = rig.spawn(Reader, "a/client/Reader")
    rig.send(Number(1), Word("a"))
    rig.send(Number(2), channel="ctrl")
    rig.settle()
    assert sorted(map(str, reader.diary)) == ["any number", "any word", "ctrl 2", "start", "system 1"]
    assert reader.diary.index("system 1") < reader.diary.index("any word")


def test_a_method_for_addressed_packets_hears_no_others_though_another_does(rig):
    class Reader(Diary):
        @on("system", Number, addressed=True)
        def mine(self, packet):
            self.diary.append(f"mine {packet.body.n}")

    reader = rig.spawn(Reader, "a/client/Reader")
    for number, to in enumerate(["", "a", "a/client/Reader", "a/client"]):
        rig.send(Number(number), to=to)
    rig.kernel.stream.inject(
        rig.source.publish("ctrl", Number(9), "*").__class__(
            "system", "test_component.number", "b/client/S", "*", 0.0, 1, Number(9)
        )
    )
    rig.settle()
    assert [entry for entry in reader.diary if str(entry).startswith("mine")] == ["mine 2", "mine 3"]
    assert [entry for entry in reader.diary if isinstance(entry, int)] == [0, 1, 2, 3, 9]


def test_a_channel_that_a_task_makes_may_be_listened_to_at_once(rig):
    class Mapper(Diary):
        def on_start(self):
            self.open_channel("map")
            self.subscribe("map", Number, self.number)

    mapper = rig.spawn(Mapper, "a/client/Mapper")
    rig.send(Number(4), channel="map")
    rig.settle()
    assert mapper.diary == [4]
    mapper.close_channel("map")
    with pytest.raises(UnknownChannel):
        rig.send(Number(5), channel="map")


# Time ----------------------------------------------------------------------------------------------------------


class Metronome(Component):
    """Notes its ticks."""

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self.ticks = []

    @every(hz=10)
    def tick(self, tick):
        self.ticks.append(tick)

    @every(hz=0)
    def other(self, tick):
        self.ticks.append(("other", tick.time_s))


def test_a_time_driven_method_is_called_at_its_rate_with_its_deadline(rig):
    metronome = rig.spawn(Metronome, "a/client/M")
    rig.run_until(1.0)
    assert metronome.ticks == [Tick(pytest.approx(k / 10), 0, 0.0) for k in range(1, 11)]


def test_a_new_rate_holds_from_the_next_tick(rig):
    metronome = rig.spawn(Metronome, "a/client/M")
    rig.run_until(1.0)
    metronome.ticks.clear()
    metronome.call(lambda: metronome.reschedule(2.0))
    rig.run_until(3.0)
    assert [tick.time_s for tick in metronome.ticks] == [1.5, 2.0, 2.5, 3.0]
    metronome.call(lambda: metronome.reschedule(0.0))
    metronome.call(lambda: metronome.reschedule(1.0, "other"))
    metronome.ticks.clear()
    rig.run_until(5.5)
    assert metronome.ticks == [("other", 4.0), ("other", 5.0)]


def test_a_rate_that_is_none_is_refused(rig):
    metronome = rig.spawn(Metronome, "a/client/M")
    for rate_hz in (-1.0, math.nan, math.inf, 1e300):
        with pytest.raises(ValueError, match="a rate must lie between 0 and 10,000 ticks a second"):
            metronome.reschedule(rate_hz)
    with pytest.raises(ValueError, match="a/client/M has no timer 'tack', only tick, other"):
        metronome.reschedule(1.0, "tack")
    with pytest.raises(ValueError, match="a/client/Source is not time-driven"):
        rig.source.reschedule(1.0)


def test_ticks_do_not_pile_up_before_an_actor_that_is_late(rig):
    """It gets one tick, for the newest deadline, that says how many it missed."""
    metronome = rig.spawn(Metronome, "a/client/M")
    timer = metronome.timers["tick"]
    assert metronome.actor_inbox.token.acquire(blocking=False)  # its dispatcher is busy elsewhere
    rig.run_until(0.55)
    put_back(metronome.actor_inbox)
    metronome.call(lambda: None)
    rig.settle()
    assert metronome.ticks == [Tick(pytest.approx(0.5), 4, pytest.approx(0.05))]
    assert timer.missed_total == 4
    assert timer.lateness_max_s == pytest.approx(0.05)


def test_what_was_put_off_comes_in_the_actor_and_never_after_its_end(rig):
    diary = rig.spawn(Diary, "a/client/Diary")
    diary.after(1.0, lambda: diary.diary.append("after"))
    diary.after_host(2.0, lambda: diary.diary.append("after host"))
    diary.after(3.0, lambda: diary.diary.append("never")).cancel()
    diary.after(5.0, lambda: diary.diary.append("too late"))
    rig.run_until(4.0)
    diary.stop()
    rig.run_until(9.0)
    assert diary.diary == ["start", "after", "after host", "stop"]


def test_a_test_may_give_an_actor_random_numbers_of_its_own_choice():
    component = Rig().spawn(Component, "x")
    component.random = random.Random(7)
    assert component.random.random() == random.Random(7).random()


def test_random_numbers_are_each_actors_own_and_repeat_with_the_seed():
    def drawn(seed, address):
        return Rig(seed=seed).spawn(Component, address).random.random()

    assert drawn(1, "a/client/T") == drawn(1, "a/client/T")
    assert drawn(1, "a/client/T") != drawn(1, "a/client/U")
    kernels = [Kernel("a", seed=seed, virtual=VirtualDispatcher(0)) for seed in (1, 2)]
    assert len({kernel.random_for("x").random() for kernel in kernels}) == 2


# Failing -------------------------------------------------------------------------------------------------------


def ends_of(rig, cls, *bodies, address="a/client/T", mailbox=None):
    """Spawns an actor, sends it packets, and returns it with the error that it ended with."""
    ends = []
    component = rig.kernel.spawn(cls, address, mailbox=mailbox, exited=lambda component, error: ends.append(error))
    rig.settle()
    rig.send(*bodies)
    rig.settle()
    return component, (ends[0] if ends else "it lives")


@pytest.mark.parametrize("error", [ValueError("bad"), SystemExit(1), KeyboardInterrupt()])
def test_any_error_ends_the_actor_and_nobody_else(rig, error):
    class Failing(Diary):
        def on_failure(self, exception_type, exception_value, traceback):
            self.diary.append(f"failed: {exception_type.__name__}")

        @on("system", Number)
        def number(self, packet):
            raise error

    other = rig.spawn(Diary, "a/client/Other")
    failing, end = ends_of(rig, Failing, Number(1))
    assert end is error
    assert failing.diary == ["start", f"failed: {type(error).__name__}"]  # `on_stop` is for an end that was meant
    assert other.diary == ["start", 1]
    assert rig.kernel.letters.count == 1
    (letter,) = [line for line in rig.lines() if "dead letter" in line]
    assert "a/client/T failed 1 time on 'test_component.number' #1 from a/client/Source" in letter


def test_an_error_at_the_start_ends_it_before_it_handles_anything(rig):
    class Failing(Diary):
        def on_start(self):
            raise RuntimeError("no hardware")

    failing, end = ends_of(rig, Failing, Number(1))
    assert str(end) == "no hardware"
    assert failing.diary == []


@pytest.mark.parametrize("error", [RuntimeError("cannot close"), SystemExit(2)])
def test_an_error_while_stopping_is_told_and_does_not_keep_it_alive(rig, error):
    class Failing(Diary):
        def on_stop(self):
            raise error

    failing, _ = ends_of(rig, Failing)
    ends = []
    failing.exited = lambda component, problem: ends.append(problem)
    stopped = failing.actor_ref.stop(block=False)
    rig.settle()
    stopped.get(timeout=0)
    assert ends == [error]
    assert not failing.actor_ref.is_alive()


def test_a_failing_on_failure_is_told_and_the_actor_ends_all_the_same(rig):
    class Failing(Diary):
        def on_failure(self, exception_type, exception_value, traceback):
            raise RuntimeError("that too")

        @on("system", Number)
        def number(self, packet):
            raise ValueError("first")

    _, end = ends_of(rig, Failing, Number(1))
    assert str(end) == "first"
    assert any("on_failure of a/client/T failed as well: RuntimeError: that too" in line for line in rig.lines())


def test_a_successor_finds_what_waited_in_the_mailbox_of_its_slot(rig):
    class Failing(Diary):
        @on("system", Word)
        def word(self, packet):
            raise ValueError(packet.body.text)

    slot = Mailbox()
    ends_of(rig, Failing, Number(1), Word("bad"), Number(2), Number(3), mailbox=slot)
    rig.send(Number(4))  # while nobody is there
    successor = rig.kernel.spawn(Diary, "a/client/T", mailbox=slot)
    rig.settle()
    assert successor.diary == ["start", 2, 3, 4]


def test_an_actor_that_ended_while_it_stood_still_does_not_leave_that_to_its_successor(rig):
    slot = Mailbox()
    first, _ = ends_of(rig, Diary, mailbox=slot)
    first.call(first.pause)
    first.stop()
    rig.settle()
    successor = rig.kernel.spawn(Diary, "a/client/T", mailbox=slot)
    rig.send(Number(1))
    rig.settle()
    assert successor.diary == ["start", 1]


class Picky(Diary):
    """Fails on unlucky numbers, each time; counts how often it was tried."""

    tries: list

    @on("system", Number, keep=reliable(9))
    def number(self, packet):
        self.tries.append(packet.body.n)
        if packet.body.n == 13:
            raise ValueError("unlucky")

    @on("system", Word, keep=queue(9))
    def word(self, packet):
        self.tries.append(packet.body.text)
        if packet.body.text == "bad":
            raise ValueError("bad word")


def lives(rig, lives_left, *bodies):
    """Starts an actor again and again on one mailbox, as its service would; returns what it tried."""
    Picky.tries = []
    slot = Mailbox()

    def exited(component, error):
        nonlocal lives_left
        lives_left -= 1
        if error is not None and lives_left > 0:
            rig.kernel.spawn(Picky, "a/client/Picky", mailbox=slot, exited=exited)

    rig.kernel.spawn(Picky, "a/client/Picky", mailbox=slot, exited=exited)
    rig.settle()
    rig.send(*bodies)
    rig.settle()
    return Picky.tries


def test_a_packet_that_may_not_be_lost_comes_three_times_and_is_then_a_dead_letter(rig):
    assert lives(rig, 9, Number(1), Number(13), Number(2)) == [1, 13, 13, 13, 2]
    assert ATTEMPTS == 3
    assert rig.kernel.letters.count == 1
    (letter,) = [line for line in rig.lines() if "dead letter" in line]
    assert "a/client/Picky failed 3 times on 'test_component.number'" in letter


def test_any_other_packet_is_a_dead_letter_at_once_though_a_reliable_one_shares_its_channel(rig):
    assert lives(rig, 9, Word("bad"), Number(1)) == ["bad", 1]
    assert rig.kernel.letters.count == 1


# Words from outside, by pykka ----------------------------------------------------------------------------------


def test_who_asks_an_actor_that_has_stopped_is_told(rig):
    diary = rig.spawn(Diary, "a/client/Diary")
    waiting = diary.actor_ref.ask("hello", block=False)
    diary.stop()
    late = diary.actor_ref.ask("are you there?", block=False)
    rig.settle()
    with pytest.raises(TypeError, match="takes packets, not 'hello'"):
        waiting.get(timeout=0)
    with pytest.raises(ActorDeadError):
        late.get(timeout=0)
    for ask in (diary.actor_ref.ask, diary.actor_ref.tell):
        with pytest.raises(ActorDeadError):
            ask("hello")


def test_a_question_that_crosses_the_end_of_an_actor_is_answered(rig):
    """`ask` looks whether the actor is alive, and puts its question in: the actor may end between the two."""
    diary = rig.spawn(Diary, "a/client/Diary")
    ref, inbox = diary.actor_ref, diary.actor_inbox
    questions = []

    class Crossing:
        def put(self, envelope):
            ref.actor_inbox = inbox
            diary.stop()
            rig.settle()
            inbox.put(envelope)
            questions.append(envelope)

    ref.actor_inbox = Crossing()
    with pytest.raises(ActorDeadError):
        ref.ask("too late", block=False).get(timeout=0)


@pytest.mark.parametrize("error", [ValueError("asked badly"), SystemExit(4)])
def test_who_asks_for_what_fails_gets_the_error(rig, error):
    class Failing(Diary):
        def fail(self):
            raise error

    failing = rig.spawn(Failing, "a/client/Failing")
    question = failing.actor_ref.proxy().fail()
    rig.settle()
    with pytest.raises(type(error)):
        question.get(timeout=0)
    # As in pykka: an error goes to who asked, and the actor lives; what would end the process ends this actor alone.
    assert failing.actor_ref.is_alive() == isinstance(error, Exception)


def test_lines_and_events_reach_the_log_and_an_agent_without_a_log_goes_on(rig):
    rig.source.log("warning", "hot")
    rig.source.event("melted", degrees=900)
    rig.settle()
    assert rig.probe.packets(LogLine)[0].body == LogLine("warning", "hot")
    assert rig.probe.packets(Event)[0].body == Event("melted", {"degrees": 900})


@pytest.mark.parametrize(("takes_s", "handled"), [(0.02, 1), (0.002, 3), (0.0004, 13), (0.0, 100)])
def test_a_turn_ends_when_its_time_is_up_however_long_each_packet_takes(takes_s, handled):
    class Slow(Component):
        count = 0

        @on("system", Number)
        def take(self, packet):
            self.count += 1
            rig.dispatcher.clock.advance_to(rig.dispatcher.clock.now() + takes_s)

    rig = Rig()
    slow = rig.spawn(Slow, "a/client/Slow")
    rig.send(*map(Number, range(100)))
    assert slow.actor_inbox.token.locked(), "its turn is due"
    slow.take_turn(0.005)
    assert slow.count == handled
    slow.actor_inbox.token.acquire(blocking=False)
    slow.take_turn(None)
    assert slow.count == 100
