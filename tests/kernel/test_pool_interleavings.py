"""The pool, interleaving by interleaving: what comes just then, and how many threads there may be."""

import threading

import pytest
from kernel.actors import holding

from pancakes.kernel import dispatchers as pool_module
from pancakes.kernel.dispatchers import SLICE_S, STOP_S, WATCH_S

PATIENCE_S = 10.0
LATER_S = 1.1 * WATCH_S


# Second looks


def test_of_two_guests_that_find_no_thread_at_work_one_is_let_in(rig):
    rig.at_rest()
    first, second = rig.guest(), rig.guest()
    rig.pool.before_lock(first.arrive)
    assert not second.arrive()
    first.leave()
    rig.at_rest()


def test_of_two_actors_that_find_no_thread_at_work_one_calls_a_worker(rig):
    first, second = rig.actor(), rig.actor()
    gate, holds, done = threading.Event(), threading.Event(), threading.Event()
    rig.at_rest()

    def comes_first():
        first.do(holding(holds, gate))
        assert holds.wait(PATIENCE_S)

    rig.pool.before_lock(comes_first)
    second.do(done.set)
    assert rig.pool.active == 1, "two workers wake each other for what one can do"
    gate.set()
    assert done.wait(PATIENCE_S)
    rig.at_rest()


def test_a_pool_that_stops_just_now_lets_no_guest_in(rig):
    rig.at_rest()
    rig.pool.before_lock(rig.end)
    assert not rig.guest().arrive()


def test_what_comes_while_a_worker_is_about_to_lie_down_it_does(rig):
    actor, other = rig.actor(), rig.actor()
    rig.at_rest()
    done = threading.Event()
    # It is at work still, so no other worker is called.
    rig.pool.before_retire = lambda: rig.pool.before_lock(lambda: other.do(done.set))
    actor.do(lambda: None)
    assert done.wait(PATIENCE_S), "a worker lay down while there was work"


def test_what_comes_while_a_guest_is_about_to_leave_a_worker_does(rig):
    actor = rig.actor()
    guest = rig.visiting()
    done = threading.Event()
    rig.pool.before_lock(lambda: actor.do(done.set))
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


def test_no_actor_has_more_than_a_slice_of_a_thread_at_a_time(rig):
    actor = rig.actor()
    guest = rig.visiting()
    actor.do(lambda: None)
    rig.turn(guest)
    actor.do(lambda: None)
    guest.work(rig.clock.now_s + 1.0)
    guest.leave()
    assert actor.slices_s == [SLICE_S] * len(actor.slices_s) and len(actor.slices_s) >= 3


def test_a_guest_without_work_does_not_wait_for_any(rig):
    guest = rig.visiting()
    guest.work(rig.clock.now_s + 1.0)
    guest.leave()


def test_an_actor_is_readied_without_the_lock_while_a_thread_is_at_work(rig):
    """Under the lock all of them would wait for each other."""
    actor = rig.actor()
    guest = rig.visiting()
    done = []
    rig.pool.before_lock(lambda: pytest.fail("it takes the lock"))
    actor.do(lambda: done.append(1))
    rig.pool.before_lock(lambda: None)
    assert rig.turn(guest) and done == [1]
    guest.leave()


def test_a_pool_that_has_stopped_begins_nothing(rig):
    actor = rig.actor()
    rig.end()
    actor.do(lambda: pytest.fail("it has stopped"))
    assert (rig.pool.workers, rig.pool.active) == (0, 0)
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
    assert rig.pool.workers == 3 and not done.is_set()
    gates[0].set()
    assert done.wait(PATIENCE_S), "no worker has come to what waited"


def test_there_are_no_more_guests_than_there_may_be(rig, monkeypatch):
    """Each that a handler holds is followed by another."""
    monkeypatch.setattr(pool_module, "MOST_WORKERS", 3)
    actor, guests = rig.actor(), []
    for _ in range(3):
        guests.append(rig.visiting())
        rig.see_held()
    last = rig.guest()
    rig.does(actor)
    rig.until(lambda: rig.pool.active == 0, "the worker never rests")
    assert not last.arrive()
    guests.pop().leave()
    assert last.arrive()
    for guest in (last, *guests):
        guest.leave()
    rig.at_rest()


def test_workers_that_were_lent_end_when_they_are_not_needed(rig):
    gates = [rig.hold()]
    for _ in range(4):
        rig.see_held()
        gates.append(rig.hold())
    assert rig.pool.workers >= 5
    for gate in gates:
        gate.set()
    rig.until(lambda: rig.pool.workers == 2, "they all stay")
    rig.at_rest()


def test_a_stop_waits_for_all_held_workers_together_no_longer_than_for_one(rig, monkeypatch):
    waited = []
    join = threading.Thread.join

    def joined(thread, timeout=None):
        if timeout is None:
            join(thread)
        else:
            waited.append(timeout)
            rig.clock.now_s += timeout

    monkeypatch.setattr(threading.Thread, "join", joined)
    for _ in range(3):
        rig.hold()
        rig.see_held()
    rig.pool.stop()
    assert waited == [pytest.approx(STOP_S), 0.0, 0.0]
