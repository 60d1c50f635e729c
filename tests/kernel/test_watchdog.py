"""The pool's watchdog: what it names, when it rests, and what it does where there are no threads."""

import logging
import threading

import pytest
from kernel.actors import holding

from pancakes.kernel import dispatchers as pool_module
from pancakes.kernel.dispatchers import DOZE_LOOKS, HOGGED_S, MOST_PASSED_S, WATCH_S

PATIENCE_S = 10.0
LATER_S = 1.1 * WATCH_S


def test_a_component_that_holds_a_thread_for_long_is_named_once_for_each_turn(rig):
    gate = rig.hold()
    rig.look()
    rig.look(0.5 * HOGGED_S)
    rig.look(0.4 * HOGGED_S)
    assert rig.named == []
    rig.look(0.2 * HOGGED_S)
    rig.look(0.5 * HOGGED_S)
    assert rig.named == [("a/1", pytest.approx(1.1 * HOGGED_S))]
    gate.set()
    rig.at_rest()
    gate = rig.hold()
    rig.look()
    rig.look(0.6 * HOGGED_S)
    rig.look(0.6 * HOGGED_S)
    assert [address for address, _ in rig.named] == ["a/1", "a/2"]
    gate.set()


def test_a_thread_that_has_only_begun_does_not_hide_one_that_is_held(rig):
    first = rig.hold()
    rig.see_held()
    second = rig.hold()
    rig.see_held()
    for _ in range(3):
        first.set()
        rig.until(lambda: rig.pool.idle, "the first thread does not come back")
        first = rig.hold()
        rig.look(0.6 * HOGGED_S)
    assert [address for address, _ in rig.named] == ["a/2"]
    first.set()
    second.set()
    rig.at_rest()


def test_a_thread_that_gives_one_short_turn_after_the_other_is_not_held(rig, monkeypatch):
    monkeypatch.setattr(pool_module, "MOST_WORKERS", 1)
    actors = [rig.actor(), rig.actor()]
    last = threading.Event()
    for number in range(10):
        gate, holds = threading.Event(), threading.Event()
        actors[number % 2].do(holding(holds, gate))
        last.set()
        assert holds.wait(10.0)
        rig.look(0.4 * HOGGED_S)
        last = gate
    last.set()
    assert rig.named == []
    rig.at_rest()


def test_a_component_that_has_ended_is_not_named(rig):
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
    for _ in range(5):
        rig.look(LATER_S)
    assert rig.named == [] and rig.pool.active == 0
    gate.set()
    rig.at_rest()


def test_no_component_is_named_because_the_whole_machine_stood_still(rig):
    """The watchdog itself came late then, and knows of no more than what it would have seen by its own periods."""
    gate = rig.hold()
    rig.look()
    rig.look(100 * HOGGED_S)
    assert rig.named == []
    rig.look(100 * HOGGED_S)
    assert rig.named == [("a/1", pytest.approx(2 * MOST_PASSED_S))], "it holds it still"
    gate.set()


def no_thread(*_):
    raise RuntimeError("can't start new thread")


def test_pool_without_threads_logs_while_its_log_gives_it_work(rig, monkeypatch):
    """An agent's log handler publishes: the pool gets work while it says that it has no thread for it."""
    actor, other = rig.new_actor(), rig.new_actor()
    may_publish, logged, done = threading.Event(), threading.Event(), threading.Event()

    def publish():
        may_publish.wait(PATIENCE_S)
        actor.do(lambda: None)

    class Publishes(logging.Handler):
        def emit(self, record):
            other.do(done.set)
            logged.set()

    rig.at_rest()
    gates = []
    while rig.pool.idle:
        gates.append(rig.hold())
        rig.see_held()
    publishes = Publishes()
    logging.getLogger().addHandler(publishes)
    try:
        with monkeypatch.context() as patch:
            publisher = threading.Thread(target=publish, daemon=True)
            publisher.start()
            patch.setattr(threading.Thread, "start", no_thread)
            may_publish.set()
            publisher.join(PATIENCE_S)
            assert logged.is_set() and not publisher.is_alive()
    finally:
        logging.getLogger().removeHandler(publishes)
        for gate in gates:
            gate.set()
    rig.look()
    assert done.wait(PATIENCE_S)
    rig.at_rest()


def test_where_no_thread_can_be_started_no_component_fails_and_work_is_done_later(rig, monkeypatch, caplog):
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        done = threading.Event()
        actor = rig.new_actor()
        actor.do(done.set)
        rig.look()
        assert len(caplog.records) == 1 and "gets none: can't start new thread" in caplog.text
        assert rig.pool.active == 0 and rig.pool.workers == 0
        assert not rig.pool.may_doze(), "the watchdog will not look again"
    rig.look()
    assert done.wait(PATIENCE_S)
    rig.at_rest()
    gates = []
    while rig.pool.idle:
        gates.append(rig.hold())
        rig.see_held()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        actor.do(lambda: None)
        assert len(caplog.records) == 2, "it is told each time that it begins"
    rig.look()
    for gate in gates:
        gate.set()
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
        raise ValueError("a fault in what it calls")

    rig.at_rest()
    rig.pool.looks = look
    rig.pool.wake_watchdog()
    for _ in range(2 * DOZE_LOOKS):
        assert looked.acquire(timeout=PATIENCE_S), "the watchdog has ended"
    rig.pool.looks = lambda: 0
    assert "the watchdog of the pool of p failed" in caplog.text


def test_a_watchdog_that_sees_visits_only_sees_that_something_is_done(rig):
    before = rig.look()
    rig.visiting().leave()
    assert rig.look() != before
    assert rig.look() == rig.look()


def test_a_watchdog_rests_once_it_has_looked_and_seen_that_nothing_was_done(rig):
    looks, looked, rests = [], [], threading.Event()

    def look():
        looks.append("something was done before the first one")
        return -2

    def seen(dozes):
        looked.append(len(looks))
        rests.set()

    rig.at_rest()
    rig.until(lambda: rig.pool.dozing, "the watchdog never rests")
    rig.pool.looks, rig.pool.seen_dozing = look, seen
    rig.pool.wake_watchdog()
    assert rests.wait(PATIENCE_S), "the watchdog never rests again"
    assert looked[0] == 2


def test_a_watchdog_does_not_rest_while_a_thread_is_here(rig):
    rig.at_rest()
    rig.until(lambda: rig.pool.dozing, "the watchdog never rests")
    gate = rig.hold()
    assert not rig.pool.dozing, "the watchdog does not watch the worker"
    gate.set()
    rig.at_rest()
    rig.until(lambda: rig.pool.dozing, "the watchdog never rests")
    guest = rig.visiting()
    assert not rig.pool.dozing, "the watchdog does not watch the guest"
    assert not rig.pool.may_doze()
    rig.see_held()
    assert not rig.pool.may_doze(), "a guest that is held is still to be watched"
    guest.leave()
    gate = rig.hold()
    rig.see_held()
    assert not rig.pool.may_doze(), "a worker that is held is still to be named"
    gate.set()


def test_a_pool_stops_while_its_watchdog_is_being_woken(rig):
    """Its alarm rings already."""
    rig.at_rest()
    stopping = threading.Thread(target=rig.end)

    def seen(dozes):
        if dozes:
            assert guest.arrive()
            stopping.start()
            rig.until(lambda: rig.pool.stopping, "the pool does not stop")
            rig.pool.pass_lock()

    guest = rig.guest()
    rig.pool.seen_dozing = seen
    rig.pool.wake_watchdog()
    rig.until(lambda: rig.pool.stopping, "the watchdog never rests")
    stopping.join(PATIENCE_S)
    assert not stopping.is_alive() and not rig.pool.watched
    rig.end = lambda: None
    guest.leave()
