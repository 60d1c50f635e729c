"""A kernel on threads, and a pool whose watchdog looks when it is told to, for the tests of what runs on them."""

import math
import threading

import pytest
from kernel.actors import Actor, holding
from kernel.hooked_pool import HookedPool
from kernel.virtual_rig import VirtualRig

from pancakes.kernel.dispatchers import WATCH_S, Guest
from pancakes.kernel.kernel import Kernel
from pancakes.testing import no_thread_left

PATIENCE_S = 10.0
LATER_S = 1.1 * WATCH_S


@pytest.fixture
def kernel():
    with no_thread_left():
        made = Kernel("a")
        yield made
        for component in reversed(made.registry.components()):
            component.actor_ref.stop(timeout=PATIENCE_S)
        made.stop()


@pytest.fixture
def virtual():
    return VirtualRig()


@pytest.fixture
def pools(monkeypatch):
    """The pools of the kernels that the test makes from now on."""
    made = []

    class Listed(HookedPool):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr("pancakes.kernel.kernel.PoolDispatcher", Listed)
    return made


class HandClock:
    """Stands still until it is moved; what waits for it to move by itself fails."""

    def __init__(self):
        self.now_s = 100.0
        self._asked = 0

    def now(self):
        self._asked += 1
        assert self._asked < 10_000, "it spins"
        return self.now_s


class Rig:
    """A pool whose watchdog looks when it is told to.

    Attributes:
        named: the components that the watchdog has named, and for how long each held its thread.
    """

    def __init__(self):
        self.clock = HandClock()
        self.named: list[tuple[str, float]] = []
        self.pool = HookedPool("p", self.clock, lambda held, held_s: self.named.append((held.address, held_s)))
        self.pool.looks = lambda: 0
        self._actors = 0
        self._gates = []

    def look(self, later_s=0.0):
        """Lets the watchdog look, in this thread, after some time."""
        self.clock.now_s += later_s
        return self.pool.look_now()

    def new_actor(self):
        """Returns one that has not had its first turn yet."""
        self._actors += 1
        return Actor(self.pool, f"a/{self._actors}")

    def actor(self):
        actor = self.new_actor()
        self.does(actor)
        return actor

    def does(self, actor):
        """Lets an actor do something, and waits until it has, though the watchdog does not look."""
        done = threading.Event()
        actor.do(done.set)
        assert done.wait(PATIENCE_S), f"no thread gives {actor.address} its turn"

    def hold(self):
        """Holds a worker; returns what lets it go on."""
        gate, holds = threading.Event(), threading.Event()
        self._gates.append(gate)
        self.actor().do(holding(holds, gate))
        assert holds.wait(PATIENCE_S)
        return gate

    def see_held(self):
        """Lets the watchdog see each thread that is held."""
        self.look()
        self.look(LATER_S)

    def guest(self, relieve=lambda: None):
        return Guest(self.pool, relieve)

    def visiting(self, relieve=lambda: None):
        """Returns a guest that has arrived; waits until no worker is at work any more."""
        guest = self.guest(relieve)
        self.until(guest.arrive, "the pool is never at rest")
        return guest

    @staticmethod
    def turn(guest):
        """Lets a guest give the turns that wait; returns whether its thread goes on."""
        guest.work(math.inf)
        return guest.stays

    def held_guest(self, relieve=lambda: None):
        """Holds a guest, in a thread of its own, in a turn; returns what lets it go on, and the thread."""
        gate, holds = threading.Event(), threading.Event()
        self._gates.append(gate)
        actor = self.actor()

        def visit():
            guest = self.visiting(relieve)
            actor.do(holding(holds, gate))
            guest.work(math.inf)
            guest.leave()

        visitor = threading.Thread(target=visit)
        visitor.start()
        assert holds.wait(PATIENCE_S)
        return gate, visitor

    def at_rest(self):
        """Waits until no thread is at work; one that was counted wrongly stays so for ever."""
        self.until(lambda: self.pool.at_rest and self.pool.active == 0, "a thread never rests")

    @staticmethod
    def until(condition, complaint):
        """Waits until a condition holds that no event tells of."""
        moment = threading.Event()
        for _ in range(int(PATIENCE_S * 1000)):
            if condition():
                return
            moment.wait(0.001)
        raise AssertionError(complaint)

    def end(self):
        for gate in self._gates:
            gate.set()
        self.pool.stop()


@pytest.fixture
def rig():
    with no_thread_left():
        made = Rig()
        yield made
        made.end()
