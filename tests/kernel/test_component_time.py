"""The timers of an actor, the calls that it puts off, and its random numbers."""

import math
import random
from time import thread_time, time

import pytest
from kernel.actors import put_back
from kernel.virtual_rig import Diary, VirtualRig

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import Tick, every
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.timer import HeardTick, MeterReading, TurnMeter
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.clock_sync import ClockOffset, PeerClock
from pancakes.packet import LocalTime, Packet
from pancakes.util.timebase import Timebase


class Metronome(ActorCore):
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


def test_a_time_driven_method_is_called_at_its_rate_with_its_deadline(virtual):
    metronome = virtual.spawn(Metronome, "a/client/M")
    virtual.run_until(1.0)
    assert metronome.ticks == [Tick(pytest.approx(k / 10), 0, 0.0) for k in range(1, 11)]


def test_a_new_rate_holds_from_the_next_tick(virtual):
    metronome = virtual.spawn(Metronome, "a/client/M")
    virtual.run_until(1.0)
    metronome.ticks.clear()
    metronome.call(lambda: metronome.reschedule(2.0))
    virtual.run_until(3.0)
    assert metronome.timers["tick"].rate_hz == 2.0
    assert metronome.timers["tick"].lateness_sum_s == 0.0
    assert [tick.time_s for tick in metronome.ticks] == [1.5, 2.0, 2.5, 3.0]
    metronome.call(lambda: metronome.reschedule(0.0))
    metronome.call(lambda: metronome.reschedule(1.0, "other"))
    metronome.ticks.clear()
    virtual.run_until(5.5)
    assert metronome.ticks == [("other", 4.0), ("other", 5.0)]


def test_a_rate_that_is_none_is_refused(virtual):
    metronome = virtual.spawn(Metronome, "a/client/M")
    for rate_hz in (-1.0, math.nan, math.inf, 1e300):
        with pytest.raises(ValueError, match="a rate must lie between 0 and 10,000 ticks a second"):
            metronome.reschedule(rate_hz)
    with pytest.raises(ValueError, match="a/client/M has no timer 'tack', only tick, other"):
        metronome.reschedule(1.0, "tack")
    with pytest.raises(ValueError, match="a/client/Source is not time-driven"):
        virtual.source.reschedule(1.0)


def test_ticks_do_not_pile_up_before_an_actor_that_is_late(virtual):
    """It gets one tick, for the newest deadline, that says how many it missed."""
    metronome = virtual.spawn(Metronome, "a/client/M")
    timer = metronome.timers["tick"]
    assert timer.describe()["lateness_max_s"] == 0.0, "it has not ticked yet"
    assert metronome.actor_inbox.token.acquire(blocking=False)  # its dispatcher is busy elsewhere
    virtual.run_until(0.55)
    put_back(metronome.actor_inbox)
    metronome.call(lambda: None)
    virtual.settle()
    assert metronome.ticks == [Tick(pytest.approx(0.5), 4, pytest.approx(0.05))]
    assert timer.missed_total == 4
    assert timer.lateness_max_s == pytest.approx(0.05)


def test_what_was_put_off_comes_in_the_actor_and_never_after_its_end(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    diary.after(1.0, lambda: diary.diary.append("after"))
    diary.after_host(2.0, lambda: diary.diary.append("after host"))
    diary.after(3.0, lambda: diary.diary.append("never")).cancel()
    diary.after(5.0, lambda: diary.diary.append("too late"))
    virtual.run_until(4.0)
    diary.stop()
    virtual.run_until(9.0)
    assert diary.diary == ["start", "after", "after host", "stop"]


def test_a_test_may_give_an_actor_random_numbers_of_its_own_choice():
    component = VirtualRig().spawn(ActorCore, "x")
    component.random = random.Random(7)
    assert component.random.random() == random.Random(7).random()


def test_random_numbers_are_each_actors_own_and_repeat_with_the_seed():
    def drawn(seed, address):
        return VirtualRig(seed=seed).spawn(ActorCore, address).random.random()

    assert drawn(1, "a/client/T") == drawn(1, "a/client/T")
    assert drawn(1, "a/client/T") != drawn(1, "a/client/U")
    kernels = [Kernel("a", seed=seed, virtual=VirtualDispatcher(0)) for seed in (1, 2)]
    assert len({kernel.random_for("x").random() for kernel in kernels}) == 2


def test_each_tick_is_told_to_listeners(virtual: VirtualRig) -> None:
    told: list[HeardTick] = []
    hear = told.append
    metronome = virtual.spawn(Metronome, "a/client/M")
    virtual.kernel.hear_ticks(hear)
    virtual.run_until(0.25)
    timer = metronome.timers["tick"]
    assert told == [(timer, Tick(0.1), 0.1), (timer, Tick(0.2), 0.1)]
    virtual.kernel.unhear_ticks(hear)
    virtual.run_until(0.55)
    assert len(told) == 2 and len(metronome.ticks) == 5


def test_a_stamp_of_another_agent_is_told_on_ones_own_mission_clock_where_its_clocks_are_known(virtual):
    kernel = virtual.kernel
    assert (kernel.restamped("a", 7.0), kernel.restamped("b", 7.0)) == (7.0, 0.0)
    ahead = PeerClock(ClockOffset(0.0, 1000.0, 0.001), Timebase(998.0 + kernel.mission.host_time(0.0), 5.0))
    kernel.peer_clock = {"b": ahead}.get
    assert kernel.restamped("b", 12.0) == pytest.approx(5.0), "its mission began at 5, two seconds before this one"
    assert kernel.restamped("b", 6.0) == 0.0, "before this one began"
    assert kernel.restamped("c", 7.0) == 0.0
    stamped = [Packet("system", "t", f"{agent}/client/T", "", 12.0, 1, None) for agent in ("a", "b", "c")]
    own, others, stranger = map(kernel.local_time, stamped)
    assert own == LocalTime(12.0, 0.0) and stranger is None
    assert others is not None and others.time_s == pytest.approx(5.0) and others.bound_s > 0.0


def test_a_timer_tells_how_late_its_ticks_were_on_average(virtual):
    metronome = virtual.spawn(Metronome, "a/client/M")
    timer = metronome.timers["tick"]
    assert timer.describe()["lateness_mean_s"] == 0.0
    virtual.run_until(0.25)
    timer.lateness_sum_s = 3.0
    assert (timer.describe()["ticks"], timer.describe()["lateness_mean_s"]) == (2, 1.5)


def test_a_subscription_that_says_nothing_else_keeps_256_packets(virtual):
    reader = virtual.spawn(ActorCore, "a/client/R")
    reader.subscribe("system", None, lambda packet: None)
    (described,) = virtual.kernel.stream.readings(reader.address)
    assert (described["limit"], described["queue"]) == (256, "256")


def test_what_turns_and_ticks_take_is_added_up_with_the_squares():
    meter = TurnMeter()
    before = meter.read()
    for used_s in (1.0, 3.0):
        meter.turn("a/client/M", used_s)
        meter.tick("a/client/M", "tick", used_s)
    assert meter.read() == MeterReading({"a/client/M": (2, 4.0)}, {("a/client/M", "tick"): (2, 4.0, 10.0)})
    assert before == MeterReading({}, {}), "a reading stays as it was"


def test_of_a_turn_only_its_own_time_is_metered(virtual: VirtualRig) -> None:
    sum(number & 7 for number in range(1_000_000))  # this thread has computed before
    diary = virtual.spawn(Diary, "a/client/Diary")
    virtual.kernel.meter = meter = TurnMeter()
    before_s = thread_time()
    diary.call(lambda: sum(number & 7 for number in range(200_000)))
    virtual.settle()
    turns, used_s = meter.read().turns["a/client/Diary"]
    assert turns == 1 and 0 < used_s <= thread_time() - before_s


def test_the_time_of_day_without_a_stamp_is_the_present_one(kernel: Kernel) -> None:
    before_s, now_s = time(), kernel.utc_s()
    assert now_s is not None and before_s - 0.1 <= now_s <= time() + 0.1


def test_in_virtual_time_there_is_no_time_of_day(virtual: VirtualRig) -> None:
    assert virtual.kernel.utc_s() is None and virtual.kernel.utc_s(1.0) is None


def test_the_timers_of_an_actor_end_with_it(virtual: VirtualRig) -> None:
    first = virtual.spawn(Metronome, "a/client/M")
    virtual.run_until(0.25)
    first.stop()
    virtual.settle()
    virtual.spawn(Diary, "a/client/M", mailbox=first.actor_inbox)
    virtual.run_until(1.0)
    assert [tick.time_s for tick in first.ticks] == pytest.approx([0.1, 0.2])


def test_a_step_is_one_thing_that_happens_also_where_others_happen_at_the_same_time(virtual: VirtualRig) -> None:
    calls: list[float] = []
    for time_s in (0.1, 0.2, 0.2, 0.2):
        virtual.dispatcher.call_at(time_s, lambda: calls.append(virtual.dispatcher.clock.now_s))
    told = []
    while virtual.dispatcher.step():
        told.append(len(calls))
    assert told == [1, 2, 3, 4] and calls == [0.1, 0.2, 0.2, 0.2]
