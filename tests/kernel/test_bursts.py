"""Ticks that are due together: a guest gives each with its turn, and all else goes on as if it came alone."""

import math
import threading

import pytest
from kernel.actors import put_back

from pancakes.events import LogLine
from pancakes.kernel.component import Component
from pancakes.kernel.handlers import every, on

PATIENCE_S = 10.0


class Ticked(Component):
    """Is ticked by hand, and does with a tick what a test has in mind."""

    idea = staticmethod(lambda component: None)

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self.done = []

    @every(hz=0)
    def tick(self, tick):
        self.done.append((tick.time_s, tick.missed))
        self.thread = threading.current_thread()
        self.idea(self)

    @every(hz=0)
    def other(self, tick):
        self.done.append("other")

    @on("system", LogLine)
    def hear(self, packet):
        self.done.append(packet.body.text)


@pytest.fixture
def burst(kernel):
    """Ticks components, all with one deadline, in this thread as a guest; then gives what waits its turn."""
    kernel._shared._look = lambda: 0

    def tick(*components, missed=0, timers=("tick",), until_s=math.inf):
        guest = arrived(kernel)
        left = iter([component.timers[name] for component in components for name in timers])
        assert guest.tick(left, 0.5, missed, until_s)
        guest.work(math.inf)
        guest.leave()
        return [timer.component for timer in left]

    return tick


def arrived(kernel):
    """Returns a guest that has arrived; waits until no worker is at work any more."""
    guest = kernel.guest(lambda: None)
    moment = threading.Event()
    for _ in range(2000):
        if guest.arrive():
            return guest
        moment.wait(0.001)
    raise AssertionError("the pool is never at rest")


def taken_from(task):
    """Takes the token, as the thread does that gives a turn; waits until the one before has ended."""
    moment = threading.Event()
    for _ in range(int(PATIENCE_S * 1000)):
        if task.actor_inbox.take_token():
            return
        moment.wait(0.001)
    raise AssertionError(f"the turn of {task.name} never ends")


def spawned(kernel, *names, cls=Ticked):
    """Spawns some that run, and returns them."""
    made = [kernel.spawn(cls, f"a/client/{name}") for name in names]
    for component in made:
        component.actor_ref.proxy().done.get(timeout=PATIENCE_S)
    return made


def test_each_gets_its_tick_in_the_guest_s_thread(kernel, burst):
    tasks = spawned(kernel, "A", "B", "C")
    assert burst(*tasks, missed=2) == []
    for task in tasks:
        assert task.done == [(0.5, 2)] and task.thread is threading.current_thread()
        timer = task.timers["tick"]
        assert (timer.ticks, timer.missed_total, timer.pending) == (1, 2, False)
    burst(*tasks)
    assert [task.done for task in tasks] == [[(0.5, 2), (0.5, 0)]] * 3


def test_a_tick_that_was_missed_while_the_one_before_was_taken_is_counted(kernel, burst):
    """The timer's thread found that one pending still, and the turn did not see any more that it was replaced."""
    (task,) = spawned(kernel, "A")
    task.timers["tick"].missed = 1
    burst(task, missed=2)
    assert task.done == [(0.5, 3)]


def test_lateness_is_heard_of_each(kernel, burst, monkeypatch):
    heard = []
    kernel.hear_lateness(heard.append)
    tasks = spawned(kernel, "A", "B")
    monkeypatch.setattr(kernel, "now", lambda: 0.75)
    burst(*tasks)
    assert heard == [(task.timers["tick"], 0.25) for task in tasks]


def test_who_has_its_turn_elsewhere_gets_the_tick_there_and_counts_what_it_missed(kernel, burst):
    busy, idle = spawned(kernel, "Busy", "Idle")
    taken_from(busy)
    burst(busy, idle)
    burst(busy, idle, missed=1)
    assert busy.done == [] and len(idle.done) == 2
    put_back(busy.actor_inbox)
    done = threading.Event()
    busy.call(done.set)
    assert done.wait(PATIENCE_S)
    assert busy.done == [(0.5, 2)]


def test_what_a_turn_elsewhere_has_left_goes_before_the_tick(kernel, burst):
    """A stop, say, that came while the turn went on."""
    ends, goes_on = spawned(kernel, "Ends", "GoesOn")
    for task, ask in ((ends, ends.stop), (goes_on, lambda: goes_on.call(lambda: goes_on.done.append("call")))):
        taken_from(task)
        ask()
        put_back(task.actor_inbox)  # it has not looked yet whether something came meanwhile
    burst(ends, goes_on)
    assert (ends.done, goes_on.done) == ([], ["call", (0.5, 0)])


def test_a_tick_that_is_late_in_its_turn_is_replaced_by_the_next_and_not_doubled(kernel, burst):
    """The system may let a thread stand still there, and another thread may be the timer's until it goes on."""
    (task,) = spawned(kernel, "A")
    take_tick = task.take_tick

    def late(timer, deferred):
        timer.fire(0.6, 0)
        take_tick(timer, deferred)

    task.take_tick = late
    burst(task)
    del task.take_tick
    burst(task)
    assert task.done == [(0.6, 1), (0.5, 0)]


def test_what_a_tick_asks_its_own_actor_for_is_done_after_it(kernel, burst):
    (task,) = spawned(kernel, "A")
    task.idea = lambda it: it.call(lambda: it.done.append("call"))
    burst(task)
    assert task.done == [(0.5, 0), "call"]


def test_who_is_stopped_by_the_tick_before_gets_none(kernel, burst):
    first, second, third = spawned(kernel, "A", "B", "C")
    first.idea = lambda it: second.stop()
    burst(first, second, third)
    assert (len(first.done), second.done, len(third.done)) == (1, [], 1)
    assert second.actor_stopped.is_set()


def test_who_stands_still_from_one_tick_on_does_not_get_its_next(kernel, burst):
    (task,) = spawned(kernel, "A")
    task.idea = lambda it: it.pause()
    burst(task, timers=("tick", "other"))
    assert task.done == [(0.5, 0)]
    task.call(task.resume)
    burst(task, timers=("other",))
    assert task.done == [(0.5, 0), "other"]


def test_a_tick_of_who_ended_is_not_given_to_its_successor(kernel, burst):
    (task,) = spawned(kernel, "A")
    task.actor_ref.stop(timeout=PATIENCE_S)
    successor = kernel.spawn(Ticked, "a/client/A", mailbox=task.actor_inbox)
    successor.actor_ref.proxy().done.get(timeout=PATIENCE_S)
    burst(task)
    assert (task.done, successor.done) == ([], [])
    burst(successor)
    assert successor.done == [(0.5, 0)]


def test_a_tick_that_fails_ends_one_and_the_others_go_on(kernel, burst):
    ends = []
    tasks = spawned(kernel, "A", "B", "C")
    tasks[1].idea = lambda it: 1 / 0
    tasks[1].exited = lambda component, error: ends.append((component.name, type(error)))
    burst(*tasks)
    burst(*tasks)
    assert ends == [("B", ZeroDivisionError)]
    assert [len(task.done) for task in tasks] == [2, 1, 2]


def test_who_has_a_thread_of_its_own_is_ticked_there(kernel, burst):
    class Blocking(Ticked):
        blocking = True

    (task,) = spawned(kernel, "A", cls=Blocking)
    ticked = threading.Event()
    task.idea = lambda it: ticked.set()
    burst(task)
    assert ticked.wait(PATIENCE_S)
    assert task.thread.name == "a-A"


def test_who_hears_of_a_tick_does_not_wait_for_all_the_others(kernel, burst):
    order = []
    first, reader, *others = spawned(kernel, "A", "R", "B", "C")
    first.idea = lambda it: it.publish("system", LogLine("info", "news"), to=reader.address)
    for task in others:
        task.idea = lambda it: order.append((it.name, list(reader.done)))
    burst(first, *others)
    assert order == [("B", ["news"]), ("C", ["news"])]


def test_after_its_time_it_gives_no_more(kernel, burst):
    first, second = spawned(kernel, "A", "B")
    assert burst(first, second, until_s=0.0) == [first, second]
    assert (first.done, second.done) == ([], [])


def test_a_guest_that_was_relieved_gives_none_of_the_ticks_that_are_left(kernel):
    kernel._shared._look = lambda: 0
    first, second = spawned(kernel, "A", "B")
    guest = arrived(kernel)

    def relieve(component):
        """Does what the watchdog does where a turn has not ended since it looked last."""
        guest._shift.seen = guest._shift.turns
        kernel._shared._hold(guest._shift)

    first.idea = relieve
    left = iter([first.timers["tick"], second.timers["tick"]])
    assert not guest.tick(left, 0.5, 0, math.inf)
    assert not guest.stays
    assert [timer.component for timer in left] == [second] and second.done == []
    guest.leave()
