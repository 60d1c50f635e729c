"""How the timer serves what is due as a guest of the pool: one visit at a time, on a clock that a test moves."""

import threading
from collections.abc import Callable

import pytest

from pancakes.kernel.dispatchers import GUEST_S
from pancakes.kernel.timer import ONE_BY_ONE_S, Timer
from pancakes.testing import no_thread_left
from pancakes.util.clock import MissionClock, MonotonicClock

PATIENCE_S = 10.0


class Clock:
    """Stands still until it is moved; counts how often it is asked, to end a loop that asks for ever."""

    def __init__(self):
        self.now_s = 100.0
        self.asked = 0

    def now(self):
        self.asked += 1
        assert self.asked < 10_000, "it spins"
        return self.now_s


class Visitor:
    """A guest that is always welcome.

    Attributes:
        turns: what is done in the turns that wait; a turn that returns False holds the guest until it is relieved.
        works_until_s: how long it was to give the turns that wait, each time.
        takes_s: how far the clock moves each time that it gives turns.
    """

    def __init__(self, clock):
        self.clock = clock
        self.takes_s = 0.0
        self.stays = True
        self.turns = []
        self.left = 0
        self.works_until_s = []

    def arrive(self):
        return True

    def turn(self):
        if self.turns and self.turns.pop(0)() is False:
            self.stays = False
        return self.stays

    def work(self, until_s):
        self.works_until_s.append(until_s)
        self.clock.now_s += self.takes_s
        while self.turns and self.turn():
            pass

    def leave(self):
        self.left += 1


class Ticked:
    """Does something with each tick."""

    def __init__(self, tick=lambda: None):
        self.deadlines = []
        self._tick = tick

    def fire(self, deadline_s, missed):
        self.deadlines.append(deadline_s)
        self._tick()


class ServedByHand(Timer):
    """Serves what is due when the test says so.

    Attributes:
        looking: called each time that it looks what is due next.
    """

    def __init__(self, name, mission, host):
        super().__init__(name, mission, host)
        self.looking: Callable[[], object] = lambda: None

    def hear(self):
        """Does what it was told."""
        while not self.actor_inbox.empty():
            self.actor_inbox.get()()

    def serve(self, guest):
        """Does what it was told, and then serves what is due."""
        self.hear()
        self._serve(guest)

    def _next_host_s(self):
        self.looking()
        return super()._next_host_s()


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def timer(clock):
    return ServedByHand("a", MissionClock(clock), clock)


def tick(timer, clock, targets, period_s=0.01):
    """Lets all be ticked from now on, and the first of the ticks be due."""
    for target in targets:
        timer.every(target, period_s)
    timer.hear()
    clock.now_s += period_s


def test_a_visit_ends_when_all_is_done_and_nothing_is_due(timer, clock):
    ticked, guest = Ticked(), Visitor(clock)
    tick(timer, clock, [ticked])
    timer.serve(guest)
    assert len(ticked.deadlines) == 1 and guest.left == 1


def test_a_visit_ends_even_where_something_is_due_all_the_time(timer, clock):
    """Its thread has other duties, and others have work."""

    def slow():
        clock.now_s += 0.0011
        assert len(ticked.deadlines) < 50, "the visit never ends"

    ticked, guest = Ticked(slow), Visitor(clock)
    tick(timer, clock, [ticked], 0.001)
    begun_s = clock.now_s
    timer.serve(guest)
    assert clock.now_s - begun_s < 2 * GUEST_S and guest.left == 1


@pytest.mark.parametrize("period_s", [0.001, 1.0])
def test_turns_keep_nothing_waiting_that_is_due_next_and_have_their_time(timer, clock, period_s):
    guest = Visitor(clock)
    tick(timer, clock, [Ticked()], period_s)
    begun_s = clock.now_s
    timer.serve(guest)
    after_a_tick, at_the_end = guest.works_until_s
    assert after_a_tick == pytest.approx(begun_s + min(period_s, ONE_BY_ONE_S))
    assert at_the_end == pytest.approx(begun_s + min(period_s, GUEST_S))


def test_a_visit_in_which_a_call_fails_ends_as_any(timer, clock):
    guest = Visitor(clock)
    timer.after_host(0.0, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        timer.serve(guest)
    assert guest.left == 1


def test_a_guest_that_is_relieved_in_a_turn_leaves_everything_to_its_successor(timer, clock):
    """The successor serves the same schedules already."""
    first, second, guest = Ticked(), Ticked(), Visitor(clock)
    guest.turns = [lambda: False, lambda: pytest.fail("a relieved guest gives another turn")]
    tick(timer, clock, [first, second])
    asked: list[bool] = []
    timer.looking = lambda: asked.append(guest.stays)
    timer.serve(guest)
    assert all(asked), "it looks into what its successor changes"
    assert guest.left == 1 and (len(first.deadlines), len(second.deadlines)) == (1, 0)
    successor = Visitor(clock)
    timer.serve(successor)
    assert (len(first.deadlines), len(second.deadlines)) == (1, 1)


def test_a_guest_that_is_relieved_while_it_gives_the_turns_that_wait_goes_too(timer, clock):
    guest = Visitor(clock)
    timer.after_host(0.0, lambda: guest.turns.append(lambda: bool(clock.now_s) and False))
    # Something is due again at once: a guest that stays would go on.
    guest.takes_s = 0.001
    later = []
    timer.after_host(0.0005, lambda: later.append(1))
    timer.serve(guest)
    assert later == [] and guest.left == 1


def test_ticks_go_on_although_the_next_call_is_further_away_than_any_wait_may_be():
    with no_thread_left():
        host = MonotonicClock()
        timer = Timer("a", MissionClock(host), host)
        timer.after_host(1e12, lambda: None)
        timer.launch()
        done = threading.Event()
        timer.after_host(0.01, done.set)
        assert done.wait(PATIENCE_S)
        timer.after_host(0.01, done.clear)
        done = threading.Event()
        timer.after_host(0.02, done.set)
        assert done.wait(PATIENCE_S), "the timer's thread has ended"
        timer.halt()
