"""A task moves from a service to the service of the same name on another agent, and to no other."""

from dataclasses import dataclass

import pytest

from pancakes.control import Migrate, Restart, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.durable.client_service import ClientService, ClientServiceCore
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.kernel.handlers import on
from pancakes.service import Service
from pancakes.supervision.restart import RestartSpec
from pancakes.task import Task, every
from pancakes.testing import AgentHandle, Fleet

WHEELS = {"wheels": "null.motors"}


class Guides(ClientService):
    """A user's own service, whose tasks can move; it fails when it sees a pose."""

    @on("system", Pose)
    def pose(self, packet):
        raise RuntimeError("off the map")


class Plain(Service):
    """A service whose tasks stay with their agent."""


class Guide(Task):
    """Counts, and holds the wheels."""

    requires = ("motors",)

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1
        self.publish("system", Load(float(self.state.n)))


def two(services_of_b: dict[str, object], seed: int = 1) -> Fleet:
    """Two agents; `a` has the task `Guide` in its service `guides`."""
    fleet = Fleet(seed, classes={"test.Guide": Guide})
    fleet.start("a", services={"guides": Guides}, devices=WHEELS, tasks={"Guide": {"type": Guide, "service": "guides"}})
    fleet.start("b", services=services_of_b, devices=WHEELS)
    fleet.connect()
    return fleet


def phase(agent: AgentHandle, service: str = "guides") -> Standing:
    owner = agent.component(service)
    place = owner.places.get(TaskId("a", "Guide")) if isinstance(owner, ClientServiceCore) else None
    return place.record.standing if place is not None else Standing.NONE


def test_it_goes_to_the_service_of_the_same_name_and_comes_back():
    with two({"guides": Guides}) as fleet:
        a, b = fleet.agents["a"], fleet.agents["b"]
        a.wait_for(Load, lambda load: load.cpu >= 5.0)
        assert a.ask(Migrate("Guide", dry_run=True)).result["winner"] == "b"
        assert a.ask(Migrate("Guide")).ok
        assert (a.running("guides"), b.running("guides"), b.running("client")) == ([], ["Guide"], [])
        assert b.task("Guide", "guides").state.n >= 5
        assert b.ask(Migrate("Guide")).ok
        assert (a.running("guides"), b.running("guides")) == (["Guide"], [])


@pytest.mark.parametrize("services", [{}, {"guides": Plain}, {"guide": Guides}], ids=["none", "plain", "another"])
@pytest.mark.parametrize("dry_run", [True, False])
def test_an_agent_without_that_service_refuses_and_nothing_is_left_behind(services: dict[str, object], dry_run: bool):
    with two(services) as fleet:
        a, b = fleet.agents["a"], fleet.agents["b"]
        fleet.run_for(1.0)  # each has noted the other's boot
        disk = dict(fleet.disk("b"))

        reply = a.ask(Migrate("Guide", dry_run=dry_run))

        there = "client, guide" if "guide" in services else "client"
        reason = f"runs no service 'guides' that takes tasks in, only {there}"
        assert reply.reason == f"no neighbour can take Guide: b: {reason}"
        assert [line["reason"] for line in reply.result["lines"]] == [reason]
        fleet.run_for(10.0)
        assert a.events("task_frozen") == []
        assert phase(a) is Standing.OWNER
        assert a.running("guides") == ["Guide"]
        assert a.task("Guide", "guides").state.n >= 100
        assert fleet.disk("b") == disk
        assert not b.kernel.registry.taken("wheels", "b/client/Driving")
        assert b.running() == []


def test_a_service_that_is_stopped_takes_nothing_in_until_it_runs_again():
    with two({"guides": Guides}) as fleet:
        a, b = fleet.agents["a"], fleet.agents["b"]
        assert b.ask(Stop("guides")).ok
        reason = "runs no service 'guides' that takes tasks in, only client"
        assert a.ask(Migrate("Guide")).reason == f"no neighbour can take Guide: b: {reason}"
        assert b.ask(Start("guides")).ok
        assert a.ask(Migrate("Guide")).ok
        assert b.running("guides") == ["Guide"]


def test_a_service_that_stops_after_its_agent_has_bid_is_a_refusal_and_the_task_runs_on():
    with two({"guides": Guides}) as fleet:
        a, b = fleet.agents["a"], fleet.agents["b"]
        fleet.faults.delay("a", "b", 0.1)
        asked = a.publish("sysctrl", Migrate("Guide"))
        b.wait_for_event("migration_bid")
        assert b.ask(Stop("guides")).ok
        reply = a.reply_to(asked)
        assert (
            reply.reason == "no neighbour can take Guide: b: runs no service 'guides' that takes tasks in, only client"
        )
        assert a.events("task_frozen") == []
        assert a.running("guides") == ["Guide"]


@pytest.mark.parametrize(
    ("restarted", "reason"), [("client", ""), ("maps", ""), ("guides", "a/guides was stopped before")]
)
def test_a_start_of_its_own_service_alone_ends_the_bidding_for_a_task(restarted, reason):
    with Fleet(1, classes={"test.Guide": Guide}) as fleet:
        services = {"guides": Guides, "maps": Guides}
        tasks = {"Guide": {"type": Guide, "service": "guides"}}
        a = fleet.start("a", services=services, devices=WHEELS, tasks=tasks)
        b = fleet.start("b", services=services, devices=WHEELS)
        fleet.connect()
        fleet.faults.delay("a", "b", 0.1)
        asked = a.publish("sysctrl", Migrate("Guide"))
        assert a.ask(Restart(restarted)).ok
        assert not b.events("migration_bid")
        assert a.reply_to(asked).reason.startswith(reason)
        fleet.run_for(2.0)
        assert (b if not reason else a).running("guides") == ["Guide"]


def test_a_tasks_own_service_has_the_say_where_it_fails_between_the_two_halves_of_a_move():
    """No other service may say in its place that nothing is known of the task."""
    never = RestartSpec("no")
    with two({"guides": {"type": Guides, "restart": never}}) as fleet:
        a, b = fleet.agents["a"], fleet.agents["b"]
        fleet.faults.delay("a", "b", 0.1)
        asked = a.publish("sysctrl", Migrate("Guide"))
        a.wait_until(lambda: phase(a) is Standing.YIELDED)
        b.publish("system", Pose(0.0, 0.0, 0.0))
        b.wait_for_event("service_failed", service="guides")
        fleet.run_for(5.0)
        assert not any("has lost its disk" in line for line in a.lines())
        assert phase(a) is Standing.RELEASED  # the register is the agent's, not the service's
        assert b.ask(Start("guides")).ok
        assert a.reply_to(asked, 60.0).ok
        assert (a.running("guides"), b.running("guides")) == ([], ["Guide"])
