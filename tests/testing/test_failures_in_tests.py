"""A test fails where an actor that Pancakes brings fails, unless the test makes it fail."""

from __future__ import annotations

import pytest

from pancakes.kernel.actor import Component
from pancakes.service import Service
from pancakes.task import Task, every
from pancakes.testing import AgentHandle, Fleet, threaded_agent


class Weak(Service):
    """Fail once it has started."""

    def on_start(self) -> None:
        self.call(fail)


class Clumsy(Task):
    """Fail at each tick."""

    @every(hz=10)
    def tick(self, tick: object) -> None:
        fail()


def fail() -> None:
    raise OSError("worn out")


def actor(agent: AgentHandle, address: str) -> Component:
    found = agent.component(address)
    assert found is not None
    return found


@pytest.mark.parametrize("address", ["client", "network", "network/TaskMigrator", "kernel/Courier"])
def test_an_actor_of_pancakes_own_fails_the_test_also_where_its_agent_is_gone(address: str) -> None:
    with pytest.raises(AssertionError, match=f"a/{address} (is|failed) .*worn out"), Fleet() as fleet:
        actor(fleet.start("a"), address).call(fail)
        fleet.run_for(1.0)
        fleet.crash("a")


def test_on_threads_too() -> None:
    with pytest.raises(AssertionError, match="t/client is .*worn out"), threaded_agent("t") as agent:
        actor(agent, "client").call(fail)
        agent.wait_until(lambda: agent.failures() != [])


def test_one_that_may_fail_and_those_of_a_user_fail_no_test() -> None:
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"Clumsy": Clumsy}, services={"weak": Weak})
        a.may_fail.add("client")
        fleet.run_for(1.0)
        actor(a, "client").call(fail)
        fleet.run_for(5.0)
        failed = {event["service"] for event in a.events("service_failed")}
        assert a.events("task_failed") and failed == {"weak", "client"}


def test_what_a_test_itself_says_comes_first() -> None:
    with pytest.raises(LookupError), Fleet() as fleet:
        actor(fleet.start("a"), "client").call(fail)
        fleet.run_for(1.0)
        raise LookupError
