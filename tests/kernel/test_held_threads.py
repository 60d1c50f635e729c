"""The pool does not count on a thread that a handler holds: others work on, and another thread runs a guest's loop."""

import threading

from kernel.actors import holding

from pancakes.kernel import dispatchers as pool_module
from pancakes.kernel.dispatchers import WATCH_S, Guest, Shift

PATIENCE_S = 10.0
LATER_S = 1.1 * WATCH_S


def test_beside_a_held_worker_no_component_waits_for_the_watchdog(rig):
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


def test_beside_a_guest_that_is_held_between_its_turns_no_component_waits_for_the_watchdog(rig):
    relieved = []
    other = rig.actor()
    guest = rig.visiting(lambda: relieved.append(1))
    rig.see_held()
    rig.does(other)
    rig.until(lambda: rig.pool.active == 0, "the worker never rests")
    assert rig.turn(guest)
    rig.look()
    rig.does(other)
    guest.leave()
    assert relieved == [], "no other thread may be in the middle of its loop"
    rig.at_rest()


def test_a_guest_that_was_held_without_a_turn_is_reckoned_with_when_it_comes_again(rig):
    guest = rig.visiting()
    rig.see_held()
    guest.leave()
    assert guest.arrive() and not rig.guest().arrive()
    guest.leave()
    rig.at_rest()


class TwiceHeld:
    """A guest, in a thread of its own, that stands still between its turns, and is then held in one.

    Attributes:
        seen: lets it have its turn.
        holds: it is in that turn.
        gate: lets the turn end.
        visitor: the thread.
    """

    def __init__(self, rig, relieve=lambda: None):
        self.seen, self.holds, self.gate, arrived = (threading.Event() for _ in range(4))
        actor = rig.actor()

        def visit():
            guest = rig.visiting(relieve)
            arrived.set()
            assert self.seen.wait(PATIENCE_S)
            # Not by way of `ready`, which would have a worker do it.
            assert actor.actor_inbox.token.acquire(blocking=False)
            actor.do(holding(self.holds, self.gate))
            rig.pool.work.append(actor.actor_inbox)
            rig.turn(guest)
            guest.leave()

        self.visitor = threading.Thread(target=visit)
        self.visitor.start()
        assert arrived.wait(PATIENCE_S)

    def end(self):
        self.gate.set()
        self.visitor.join(PATIENCE_S)


def test_a_guest_that_is_first_held_between_turns_and_then_in_one_is_relieved(rig):
    relieved = []
    guest = TwiceHeld(rig, lambda: relieved.append(1))
    rig.see_held()
    assert rig.pool.active == 0
    guest.seen.set()
    assert guest.holds.wait(PATIENCE_S)
    rig.see_held()
    assert relieved == [1]
    guest.end()
    rig.at_rest()


def test_a_guest_that_is_not_reckoned_with_comes_back_though_the_watchdog_sees_another_turn(rig):
    guest = TwiceHeld(rig)
    rig.see_held()

    def too_late(hold):
        guest.seen.set()
        assert guest.holds.wait(PATIENCE_S)
        hold()

    rig.pool.around_hold = too_late
    rig.look()
    assert rig.pool.active == 0
    guest.end()
    rig.at_rest()


def test_no_component_waits_for_a_worker_that_was_called_and_does_not_come(rig):
    """The machine may have no core for it."""
    actor = rig.actor()
    rig.at_rest()
    hear = rig.pool.deafen_idle_worker()
    done = threading.Event()
    actor.do(done.set)
    rig.look()
    assert rig.pool.active == 1
    rig.look(LATER_S)
    assert done.wait(PATIENCE_S), "no other worker has come"
    hear()
    rig.at_rest()


def test_a_worker_whose_turn_has_ended_is_reckoned_with_in_its_next(rig, monkeypatch):
    """Else another would be at work beside it as long as it finds work."""
    monkeypatch.setattr(pool_module, "MOST_WORKERS", 1)  # no other worker comes to what waits
    waiting, first = rig.actor(), rig.hold()
    rig.see_held()
    gate, holds = threading.Event(), threading.Event()
    waiting.do(holding(holds, gate))
    assert rig.pool.active == 0
    first.set()
    assert holds.wait(PATIENCE_S)
    counted = rig.pool.active
    gate.set()
    assert counted == 1
    rig.at_rest()


def test_a_worker_that_has_come_back_just_now_is_reckoned_with(rig):
    gate = rig.hold()

    def too_late(hold):
        gate.set()
        rig.until(lambda: rig.pool.idle, "the worker does not come back")
        hold()

    rig.look()
    rig.pool.around_hold = too_late
    rig.look(LATER_S)
    rig.at_rest()


def test_a_guest_that_has_got_on_just_now_leaves_after_its_next_turn_at_the_latest(rig):
    """The watchdog saw it for long in the turn before."""
    relieved, stays = [], []
    gates = [threading.Event(), threading.Event()]
    holds = [threading.Event(), threading.Event()]
    actors = [rig.actor(), rig.actor()]

    def visit():
        guest = rig.visiting(lambda: relieved.append(1))
        for number, actor in enumerate(actors):
            actor.do(holding(holds[number], gates[number]))
        stays.append(rig.turn(guest))
        guest.leave()

    def too_late(hold):
        gates[0].set()
        assert holds[1].wait(PATIENCE_S)
        hold()

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert holds[0].wait(PATIENCE_S)
    rig.look()
    rig.pool.around_hold = too_late
    rig.look(LATER_S)
    assert relieved == [1] and rig.pool.active == 0
    gates[1].set()
    visitor.join(PATIENCE_S)
    assert stays == [False]
    rig.at_rest()


def test_a_guest_whose_turn_ends_while_it_is_relieved_goes(rig):
    """It has laid its mailbox down, but not yet looked whether it stays."""

    class Seen(Shift):
        """Lets the guest end its turn while the watchdog looks whether it is in one."""

        hook = staticmethod(lambda: None)

        @property
        def mailbox(self):
            seen = self.its_mailbox
            self.hook()
            return seen

        @mailbox.setter
        def mailbox(self, mailbox):
            self.its_mailbox = mailbox

    relieved, stays = [], []
    gate, holds, back = threading.Event(), threading.Event(), threading.Event()
    actor = rig.actor()

    class Watched(Guest):
        def __init__(self):
            super().__init__(rig.pool, lambda: relieved.append(1))
            self.shift = self._shift = Seen(lambda: relieved.append(1))

    guest = Watched()

    def visit():
        rig.until(guest.arrive, "the pool is never at rest")
        actor.do(holding(holds, gate))
        stays.append(rig.turn(guest))
        back.set()
        guest.leave()

    def ends_its_turn():
        Seen.hook = staticmethod(lambda: None)
        gate.set()
        rig.until(lambda: guest.shift.mailbox is None, "its turn does not end")
        back.wait(0.05)  # as long as a guest needs that looks too early; one that does not waits for the watchdog

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert holds.wait(PATIENCE_S)
    rig.look()
    rig.clock.now_s += LATER_S

    def while_it_is_held(hold):
        Seen.hook = staticmethod(ends_its_turn)
        hold()

    rig.pool.around_hold = while_it_is_held
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
