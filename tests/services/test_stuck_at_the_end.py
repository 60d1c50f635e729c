"""A task that never comes back from what it does: the rest of its agent stops in order all the same."""

import threading

from pancakes.bodies.devices.driver import Actuator
from pancakes.runtime.clock import MonotonicClock
from pancakes.task import Task, every
from pancakes.testing import threaded_agent

RELEASED = threading.Event()
ENTERED = threading.Event()
CLOSED = threading.Event()


class Waits(Task):
    """Waits for what does not come."""

    blocking = True

    @every(hz=20)
    def wait(self, tick):
        ENTERED.set()
        RELEASED.wait(10.0)


class Wheels(Actuator):
    """Says when it was closed."""

    type = "motors"

    def apply(self, command, ttl_s, source):
        pass

    def hold(self):
        pass

    def close(self):
        CLOSED.set()


def test_wheels_are_stopped_in_order_although_a_task_is_stuck():
    clock = MonotonicClock()
    try:
        with threaded_agent(tasks={"Waits": Waits}, devices={"motors": Wheels}) as agent:
            assert ENTERED.wait(5.0)
            began_s = clock.now()
            agent.stop()
            took_s = clock.now() - began_s
        assert CLOSED.is_set()
        assert took_s < 2.0
        assert any("Waits is stuck" in line for line in agent.lines("error"))
    finally:
        RELEASED.set()
