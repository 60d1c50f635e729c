"""The pool, interleaving by interleaving: its watchdog looks only when a test says so, on a clock that a test moves."""

import threading

import pytest

from pancakes.kernel import pool as pool_module
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.pool import DOZE_LOOKS, HOGGED_S, SLICE_S, STOP_S, WATCH_S, Guest, PoolDispatcher, _Shift
from pancakes.testing import no_thread_left

PATIENCE_S = 10.0
LATER_S = 1.1 * WATCH_S


class HandClock:
    """Stands still until it is moved; who waits for it to move by itself fails."""

    def __init__(self):
        self.now_s = 100.0
        self._asked = 0

    def now(self):
        self._asked += 1
        assert self._asked < 10_000, "it spins"
        return self.now_s


class Actor:
    """As much of a component as a dispatcher needs: does in its turns what it is told."""

    def __init__(self, pool, address):
        self.address = address
        self.slices_s = []
        self.actor_inbox = Mailbox()
        pool.attach(self)

    def take_turn(self, slice_s, timer=None):
        self.slices_s.append(slice_s)
        control = self.actor_inbox.control
        if control:
            control.popleft()()

    def do(self, function):
        self.actor_inbox.put(function)


class Rig:
    """A pool whose watchdog looks when it is told to.

    Attributes:
        named: whom the watchdog has named.
    """

    def __init__(self):
        self.clock = HandClock()
        self.named = []
        self.pool = PoolDispatcher("p", self.clock, lambda address, held_s: self.named.append((address, held_s)))
        self.pool._look = lambda: 0
        self._actors = 0
        self._gates = []

    def look(self, later_s=0.0):
        """Lets the watchdog look, in this thread, after some time."""
        self.clock.now_s += later_s
        return PoolDispatcher._look(self.pool)

    def actor(self):
        self._actors += 1
        actor = Actor(self.pool, f"a/{self._actors}")
        self.does(actor)
        return actor

    def does(self, actor):
        """Lets an actor do something, and waits until it has, though the watchdog does not look."""
        done = threading.Event()
        actor.do(done.set)
        assert done.wait(PATIENCE_S), f"nobody gives {actor.address} its turn"

    def hold(self):
        """Holds a worker; returns what lets it go on."""
        gate, holds = threading.Event(), threading.Event()
        self._gates.append(gate)
        self.actor().do(lambda: (holds.set(), gate.wait(PATIENCE_S)))
        assert holds.wait(PATIENCE_S)
        return gate

    def see_held(self):
        """Lets the watchdog see everybody who is held."""
        self.look()
        self.look(LATER_S)

    def guest(self, relieve=lambda: None):
        return Guest(self.pool, relieve)

    def visiting(self, relieve=lambda: None):
        """Returns a guest that has arrived; waits until no worker is at work any more."""
        guest = self.guest(relieve)
        until(guest.arrive, "the pool is never at rest")
        return guest

    def held_guest(self, relieve=lambda: None):
        """Holds a guest, in a thread of its own, in a turn; returns what lets it go on, and the thread."""
        gate, holds = threading.Event(), threading.Event()
        self._gates.append(gate)
        actor = self.actor()

        def visit():
            guest = self.visiting(relieve)
            actor.do(lambda: (holds.set(), gate.wait(PATIENCE_S)))
            guest.turn()
            guest.leave()

        visitor = threading.Thread(target=visit)
        visitor.start()
        assert holds.wait(PATIENCE_S)
        return gate, visitor

    def at_rest(self):
        """Waits until nobody is at work; who has been counted wrongly stays so for ever."""
        until(lambda: len(self.pool._idle) == len(self.pool._workers) and not self.pool._guests, "somebody never rests")
        assert self.pool._active == 0

    def end(self):
        for gate in self._gates:
            gate.set()
        self.pool.stop()


class Interposed:
    """A lock before which something else happens, once."""

    def __init__(self, lock, before):
        self._lock = lock
        self._before = before

    def __enter__(self):
        before, self._before = self._before, lambda: None
        before()
        self._lock.acquire()

    def __exit__(self, *_):
        self._lock.release()


def until(condition, complaint):
    """Waits until something is so that nobody tells of."""
    moment = threading.Event()
    for _ in range(int(PATIENCE_S * 1000)):
        if condition():
            return
        moment.wait(0.001)
    raise AssertionError(complaint)


@pytest.fixture
def rig():
    with no_thread_left():
        made = Rig()
        yield made
        made.end()


# Who is held is not reckoned with


def test_beside_a_held_worker_nobody_waits_for_the_watchdog(rig):
    """Else all others would be given their turns at its pace: fifty times a second, as long as the handler takes."""
    other = rig.actor()
    gates = [rig.hold()]
    rig.see_held()
    rig.does(other)
    gates.append(rig.hold())
    rig.see_held()
    rig.does(other)
    for gate in gates:
        gate.set()
    rig.at_rest()


def test_beside_a_held_guest_others_work_at_once_and_it_is_relieved_once(rig):
    relieved = []
    gate, visitor = rig.held_guest(lambda: relieved.append(1))
    for _ in range(3):
        rig.see_held()
    assert relieved == [1]
    successor = rig.guest()
    assert successor.arrive(), "the guest's successor must wait until its handler is done"
    gate.set()
    visitor.join(PATIENCE_S)
    assert not rig.guest().arrive(), "there are two at work"
    successor.leave()
    rig.at_rest()


def test_beside_a_guest_that_is_held_between_its_turns_nobody_waits_for_the_watchdog(rig):
    relieved = []
    other = rig.actor()
    guest = rig.visiting(lambda: relieved.append(1))
    rig.see_held()
    rig.does(other)
    until(lambda: rig.pool._active == 0, "the worker never rests")
    assert guest.turn()
    rig.look()
    rig.does(other)
    guest.leave()
    assert relieved == [], "nobody else may be in the middle of its loop"
    rig.at_rest()


def test_a_guest_that_was_held_without_a_turn_is_reckoned_with_when_it_comes_again(rig):
    guest = rig.visiting()
    rig.see_held()
    guest.leave()
    assert guest.arrive() and not rig.guest().arrive()
    guest.leave()
    rig.at_rest()


def test_a_guest_that_is_first_held_between_turns_and_then_in_one_is_relieved(rig):
    relieved = []
    gate, holds = threading.Event(), threading.Event()
    actor, seen = rig.actor(), threading.Event()

    def visit():
        guest = rig.visiting(lambda: relieved.append(1))
        arrived.set()
        assert seen.wait(PATIENCE_S)
        # Not by way of `ready`, which would have a worker do it.
        assert actor.actor_inbox.token.acquire(False)
        actor.actor_inbox.control.append(lambda: (holds.set(), gate.wait(PATIENCE_S)))
        rig.pool.work.append(actor.actor_inbox)
        guest.turn()
        guest.leave()

    arrived = threading.Event()
    visitor = threading.Thread(target=visit)
    visitor.start()
    assert arrived.wait(PATIENCE_S)
    rig.see_held()
    assert rig.pool._active == 0
    seen.set()
    assert holds.wait(PATIENCE_S)
    rig.see_held()
    assert relieved == [1]
    gate.set()
    visitor.join(PATIENCE_S)
    rig.at_rest()


def test_a_guest_that_is_not_reckoned_with_comes_back_though_the_watchdog_sees_another_turn(rig):
    gate, arrived, seen, holds = (threading.Event() for _ in range(4))
    actor = rig.actor()

    def visit():
        guest = rig.visiting()
        arrived.set()
        assert seen.wait(PATIENCE_S)
        assert actor.actor_inbox.token.acquire(False)
        actor.actor_inbox.control.append(lambda: (holds.set(), gate.wait(PATIENCE_S)))
        rig.pool.work.append(actor.actor_inbox)
        guest.turn()
        guest.leave()

    def too_late(shift):
        seen.set()
        assert holds.wait(PATIENCE_S)
        hold(shift)

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert arrived.wait(PATIENCE_S)
    rig.see_held()
    hold, rig.pool._hold = rig.pool._hold, too_late
    rig.look()
    assert rig.pool._active == 0
    gate.set()
    visitor.join(PATIENCE_S)
    rig.at_rest()


def test_nobody_waits_for_a_worker_that_was_called_and_does_not_come(rig):
    """The machine may have no core for it."""

    class Slow:
        """A bell that the worker does not hear yet."""

        def release(self):
            pass

    actor = rig.actor()
    rig.at_rest()
    worker = rig.pool._idle[-1]
    bell, worker.wake = worker.wake, Slow()
    done = threading.Event()
    actor.do(done.set)
    rig.look()
    assert rig.pool._active == 1
    rig.look(LATER_S)
    assert done.wait(PATIENCE_S), "nobody else has come"
    worker.wake = bell
    bell.release()
    rig.at_rest()


def test_a_worker_that_has_come_back_just_now_is_reckoned_with(rig):
    gate = rig.hold()
    hold = rig.pool._hold

    def too_late(shift):
        gate.set()
        until(lambda: rig.pool._idle, "the worker does not come back")
        hold(shift)

    rig.look()
    rig.pool._hold = too_late
    rig.look(LATER_S)
    rig.at_rest()


def test_a_worker_that_comes_back_while_it_is_looked_at_is_counted_once(rig, monkeypatch):
    """It has seen the mark that the watchdog takes away again."""

    class Marked(_Shift):
        """Lets the turn end as soon as the mark is set."""

        hook = staticmethod(lambda: None)
        mark = False

        @property
        def held(self):
            return self.mark

        @held.setter
        def held(self, mark):
            self.mark = mark
            if mark:
                Marked.hook(self)

    def ends_its_turn(shift):
        gates[1].set()
        until(lambda: shift.mailbox is None, "its turn does not end")

    def too_late(shift):
        gates[0].set()
        assert holds.wait(PATIENCE_S)
        Marked.hook = staticmethod(ends_its_turn)
        hold(shift)

    monkeypatch.setattr(pool_module, "_Shift", Marked)
    other, holds = rig.actor(), threading.Event()
    gates = [rig.hold(), threading.Event()]
    other.do(lambda: (holds.set(), gates[1].wait(PATIENCE_S)))
    rig.look()
    hold, rig.pool._hold = rig.pool._hold, too_late
    rig.look(LATER_S)
    rig.at_rest()


def test_a_guest_that_is_in_another_turn_by_now_is_not_relieved(rig):
    relieved = []
    gates = [threading.Event(), threading.Event()]
    holds = [threading.Event(), threading.Event()]
    actors = [rig.actor(), rig.actor()]

    def visit():
        guest = rig.visiting(lambda: relieved.append(1))
        for number, actor in enumerate(actors):
            actor.do(lambda number=number: (holds[number].set(), gates[number].wait(PATIENCE_S)))
        guest.turn()
        guest.turn()
        guest.leave()

    def too_late(shift):
        gates[0].set()
        assert holds[1].wait(PATIENCE_S)
        hold(shift)

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert holds[0].wait(PATIENCE_S)
    rig.look()
    hold, rig.pool._hold = rig.pool._hold, too_late
    rig.look(LATER_S)
    assert relieved == [] and rig.pool._active == 1
    gates[1].set()
    visitor.join(PATIENCE_S)
    rig.at_rest()


def test_a_guest_whose_turn_ends_while_it_is_relieved_goes(rig):
    """It has laid its mailbox down, but not yet looked whether it stays."""

    class Seen(_Shift):
        """Lets the guest end its turn while the watchdog looks at it."""

        hook = staticmethod(lambda: None)

        @property
        def seen(self):
            self.hook()
            return self.its_seen

        @seen.setter
        def seen(self, turn):
            self.its_seen = turn

    relieved, stays = [], []
    gate, holds, back = threading.Event(), threading.Event(), threading.Event()
    actor = rig.actor()
    guest = rig.guest()
    guest._shift = shift = Seen(lambda: relieved.append(1))

    def visit():
        until(guest.arrive, "the pool is never at rest")
        actor.do(lambda: (holds.set(), gate.wait(PATIENCE_S)))
        stays.append(guest.turn())
        back.set()
        guest.leave()

    def ends_its_turn():
        Seen.hook = staticmethod(lambda: None)
        gate.set()
        until(lambda: shift.mailbox is None, "its turn does not end")
        back.wait(0.05)  # as long as a guest needs that looks too early; one that does not waits for the watchdog

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert holds.wait(PATIENCE_S)
    rig.look()
    rig.clock.now_s += LATER_S
    hold = rig.pool._hold
    rig.pool._hold = lambda it: (setattr(Seen, "hook", staticmethod(ends_its_turn)), hold(it))
    rig.look()
    visitor.join(PATIENCE_S)
    assert stays == [not relieved], "two threads are in one loop, or none is"
    rig.at_rest()


def test_a_guest_that_comes_again_after_a_while_was_not_held_all_that_time(rig):
    guest = rig.visiting()
    rig.look()
    guest.leave()
    rig.clock.now_s += 10.0
    assert guest.arrive()
    rig.look()
    assert not rig.guest().arrive()
    guest.leave()


def test_whoever_holds_a_thread_for_long_is_named_once_for_each_turn(rig):
    gate = rig.hold()
    rig.look()
    rig.look(0.9 * HOGGED_S)
    assert rig.named == []
    rig.look(0.2 * HOGGED_S)
    rig.look(HOGGED_S)
    assert rig.named == [("a/1", pytest.approx(1.1 * HOGGED_S))]
    gate.set()
    rig.at_rest()
    gate = rig.hold()
    rig.look()
    rig.look(1.1 * HOGGED_S)
    assert [address for address, _ in rig.named] == ["a/1", "a/2"]
    gate.set()


def test_nobody_is_named_where_the_component_has_ended_that_holds_a_thread(rig):
    """What is told of its end may hold it still."""
    gate, holds = threading.Event(), threading.Event()
    actor = rig.actor()

    def end():
        actor.actor_inbox.component = None
        holds.set()
        gate.wait(PATIENCE_S)

    actor.do(end)
    assert holds.wait(PATIENCE_S)
    rig.see_held()
    rig.look(2 * HOGGED_S)
    assert rig.named == [] and rig.pool._active == 0
    gate.set()
    rig.at_rest()


# Second looks


def test_of_two_guests_that_find_nobody_at_work_one_is_let_in(rig):
    rig.at_rest()
    first, second = rig.guest(), rig.guest()
    rig.pool._lock = Interposed(rig.pool._lock, lambda: first.arrive())
    assert not second.arrive()
    first.leave()
    rig.at_rest()


def test_of_two_that_find_nobody_at_work_one_calls_a_worker(rig):
    first, second = rig.actor(), rig.actor()
    gate, holds, done = threading.Event(), threading.Event(), threading.Event()
    rig.at_rest()

    def comes_first():
        first.do(lambda: (holds.set(), gate.wait(PATIENCE_S)))
        assert holds.wait(PATIENCE_S)

    rig.pool._lock = Interposed(rig.pool._lock, comes_first)
    second.do(done.set)
    assert rig.pool._active == 1, "two workers wake each other for what one can do"
    gate.set()
    assert done.wait(PATIENCE_S)
    rig.at_rest()


def test_a_pool_that_stops_just_now_lets_no_guest_in(rig):
    rig.at_rest()
    rig.pool._lock = Interposed(rig.pool._lock, rig.end)
    assert not rig.guest().arrive()


def test_what_comes_while_a_worker_is_about_to_lie_down_it_does(rig):
    actor, other = rig.actor(), rig.actor()
    rig.at_rest()
    done = threading.Event()
    # It is at work still, so nobody else is called.
    rig.pool.retire = lambda worker: (
        setattr(rig.pool, "_lock", Interposed(rig.pool._lock, lambda: other.do(done.set))),
        delattr(rig.pool, "retire"),
        rig.pool.retire(worker),
    )[-1]
    actor.do(lambda: None)
    assert done.wait(PATIENCE_S), "a worker lay down while there was work"


def test_what_comes_while_a_guest_is_about_to_leave_a_worker_does(rig):
    actor = rig.actor()
    guest = rig.visiting()
    done = threading.Event()
    rig.pool._lock = Interposed(rig.pool._lock, lambda: actor.do(done.set))
    guest.leave()
    assert done.wait(PATIENCE_S), "a guest has left while there was work"


# Bounds


def test_a_guest_gives_no_turns_after_its_time(rig):
    turns = []
    actor = rig.actor()
    guest = rig.visiting()

    def again():
        turns.append(rig.clock.now_s)
        rig.clock.now_s += 0.001
        if len(turns) < 100:
            actor.do(again)

    actor.do(again)
    begun_s = rig.clock.now_s
    guest.work(begun_s + 0.0025)
    assert turns == [pytest.approx(begun_s + 0.001 * count) for count in range(3)]
    turns.extend([0.0] * 100)
    guest.leave()


def test_nobody_has_more_than_a_slice_of_a_thread_at_a_time(rig):
    class Timer:
        """As much of a task's timer as a guest needs."""

        pending = False

        def __init__(self, actor):
            self.mailbox = actor.actor_inbox

        def arm(self, deadline_s, missed):
            pass

    actor = rig.actor()
    guest = rig.visiting()
    actor.do(lambda: None)
    guest.turn()
    actor.do(lambda: None)
    guest.work(rig.clock.now_s + 1.0)
    guest.tick(iter([Timer(actor)]), 0.0, 0, rig.clock.now_s + 1.0)
    guest.leave()
    assert actor.slices_s == [SLICE_S] * len(actor.slices_s) and len(actor.slices_s) >= 5


def test_a_guest_without_work_does_not_wait_for_any(rig):
    guest = rig.visiting()
    guest.work(rig.clock.now_s + 1.0)
    guest.leave()


def test_who_readies_somebody_while_there_is_one_at_work_does_nothing_else(rig):
    """Under the lock all of them would wait for each other."""
    actor = rig.actor()
    guest = rig.visiting()
    lock, rig.pool._lock = rig.pool._lock, None
    done = []
    actor.do(lambda: done.append(1))
    rig.pool._lock = lock
    assert guest.turn() and done == [1]
    guest.leave()


def test_a_pool_that_has_stopped_begins_nothing(rig):
    actor = rig.actor()
    rig.end()
    actor.do(lambda: pytest.fail("it has stopped"))
    assert rig.pool._workers == [] and rig.pool._active == 0
    rig.end()
    rig.end()


def test_there_are_no_more_workers_than_there_may_be(rig, monkeypatch):
    monkeypatch.setattr(pool_module, "MOST_WORKERS", 3)
    waiting = rig.actor()
    gates = [rig.hold()]
    while len(gates) < 3:
        rig.see_held()
        gates.append(rig.hold())
    rig.see_held()
    done = threading.Event()
    waiting.do(done.set)
    rig.look(LATER_S)
    assert len(rig.pool._workers) == 3 and not done.is_set()
    gates[0].set()
    assert done.wait(PATIENCE_S), "nobody has come to what waited"


def test_workers_that_were_lent_end_when_they_are_not_needed(rig):
    gates = [rig.hold()]
    for _ in range(4):
        rig.see_held()
        gates.append(rig.hold())
    assert len(rig.pool._workers) >= 5
    for gate in gates:
        gate.set()
    until(lambda: len(rig.pool._workers) == 2, "they all stay")
    rig.at_rest()


def test_a_stop_waits_for_all_held_workers_together_no_longer_than_for_one(rig):
    class Held:
        """A worker that does not end."""

        def join(self, timeout):
            waited.append(timeout)
            rig.clock.now_s += timeout

    waited = []
    workers, rig.pool._workers = rig.pool._workers, [Held(), Held(), Held()]
    rig.end()
    rig.pool._workers = workers
    assert waited == [pytest.approx(STOP_S), 0.0, 0.0]


# Where there are no threads


def no_thread(*_):
    raise RuntimeError("can't start new thread")


def test_where_no_thread_can_be_started_nobody_fails_and_work_is_done_later(rig, monkeypatch, caplog):
    with monkeypatch.context() as patch:
        patch.setattr(pool_module._Worker, "start", no_thread)
        done = threading.Event()
        actor = Actor(rig.pool, "a/late")
        actor.do(done.set)
        rig.look()
        assert len(caplog.records) == 1 and "gets none: can't start new thread" in caplog.text
        assert rig.pool._active == 0 and rig.pool._workers == []
        assert not rig.pool._may_doze(), "nobody will look again"
    rig.look()
    assert done.wait(PATIENCE_S)
    rig.at_rest()
    with monkeypatch.context() as patch:
        patch.setattr(pool_module._Worker, "start", no_thread)
        rig.pool._idle, rig.pool._workers, kept = [], [], (rig.pool._idle, rig.pool._workers)
        actor.do(lambda: None)
        assert len(caplog.records) == 2, "it is told each time that it begins"
        rig.pool._idle, rig.pool._workers = kept
    rig.look()
    rig.at_rest()


def test_a_guest_for_whose_relief_there_is_no_thread_is_relieved_later(rig):
    relieved = []

    def relieve():
        relieved.append(1)
        if len(relieved) == 1:
            no_thread()

    gate, visitor = rig.held_guest(relieve)
    with pytest.raises(RuntimeError):
        rig.see_held()
    gate.set()
    visitor.join(PATIENCE_S)
    rig.look()
    rig.look()
    assert relieved == [1, 1]


def test_a_watchdog_that_fails_looks_again_and_does_not_rest(rig, caplog):
    looked = threading.Semaphore(0)

    def look():
        looked.release()
        raise ValueError("a fault in whoever is told")

    rig.at_rest()
    rig.pool._look = look
    with rig.pool._lock:
        rig.pool._watch_again()
    for _ in range(2 * DOZE_LOOKS):
        assert looked.acquire(timeout=PATIENCE_S), "the watchdog has ended"
    rig.pool._look = lambda: 0
    assert "the watchdog of the pool of p failed" in caplog.text


# When the watchdog rests


def test_a_watchdog_that_sees_visits_only_sees_that_something_is_done(rig):
    before = rig.look()
    rig.visiting().leave()
    assert rig.look() != before
    assert rig.look() == rig.look()


def test_a_watchdog_does_not_rest_while_somebody_is_here(rig):
    rig.at_rest()
    until(lambda: rig.pool._dozing, "the watchdog never rests")
    gate = rig.hold()
    assert not rig.pool._dozing, "nobody watches the worker"
    gate.set()
    rig.at_rest()
    until(lambda: rig.pool._dozing, "the watchdog never rests")
    guest = rig.visiting()
    assert not rig.pool._dozing, "nobody watches the guest"
    assert not rig.pool._may_doze()
    rig.see_held()
    assert not rig.pool._may_doze(), "a guest that is held is still to be watched"
    guest.leave()
    gate = rig.hold()
    rig.see_held()
    assert not rig.pool._may_doze(), "a worker that is held is still to be named"
    gate.set()


def test_a_pool_stops_while_its_watchdog_is_being_woken(rig):
    """Its alarm rings already."""
    rig.at_rest()
    may_doze = rig.pool._may_doze
    stopping = threading.Thread(target=rig.end)

    def hooked():
        dozes = may_doze()
        if dozes:
            assert guest.arrive()
            stopping.start()
            until(lambda: rig.pool._stopping, "nobody stops")
            with rig.pool._lock:
                pass
        return dozes

    guest = rig.guest()
    rig.pool._may_doze = hooked
    with rig.pool._lock:
        rig.pool._watch_again()
    until(lambda: rig.pool._stopping, "the watchdog never rests")
    stopping.join(PATIENCE_S)
    assert not stopping.is_alive() and not rig.pool._watchdog.is_alive()
    rig.end = lambda: None
    guest.leave()
