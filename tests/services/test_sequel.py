"""What follows a hand-over: `then`, and the account. Neither is forgotten where an agent is started anew in between."""

from dataclasses import dataclass
from typing import Any

import pytest

from pancakes.control import Migrate, Migrations, Stop
from pancakes.mesh.migration.messages import Solicit
from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.mesh.net.memory import Quality
from pancakes.packet import SYSCTRL
from pancakes.runtime.hosting.bidding_messages import MIGRATOR, HasMoved, MoveOver, Negotiate
from pancakes.runtime.hosting.client import ClientService
from pancakes.service import Service
from pancakes.task import Task, every
from pancakes.testing import FleetInTest


class Circle(Task):
    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1


class Home(Circle):
    pass


class Listens(Task):
    """Keeps what it is told."""

    def on_start(self):
        self.heard = []

    def on_receive(self, message):
        if isinstance(message, MoveOver):
            self.heard.append(message)
            return None
        return super().on_receive(message)


class Surveys(ClientService):
    """A service of a user's own."""


def two(seed=3):
    fleet = FleetInTest(seed, classes={"test.Circle": Circle, "test.Home": Home})
    fleet.start("a", tasks={"Circle": Circle, "Home": {"type": Home, "start": False}})
    fleet.start("b")
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.01))
    return fleet


def phase(fleet, agent, name="Circle"):
    place = fleet.agents[agent].component("client").places.get(TaskId("a", name))
    return place.standing.record.phase if place is not None else Phase.ABSENT


def until(fleet, condition):
    begin_s = fleet.now()
    while not condition():
        assert fleet.fleet.dispatcher.step() and fleet.now() < begin_s + 20.0


def moving(fleet, wanted, **others):
    """a moves Circle, and is stopped at the moment when its record is so."""
    fleet.run_for(1.0)
    asked = fleet.agents["a"].publish(SYSCTRL, Migrate("Circle", **others))
    until(fleet, lambda: phase(fleet, "a") is wanted)
    return asked


@pytest.mark.parametrize("first", range(0, 60, 6))
def test_wherever_the_source_dies_after_the_point_of_no_return_the_other_task_follows_once(first):
    for steps in range(first, first + 6):
        with two() as fleet:
            moving(fleet, Phase.COMMITTED, then="Home")
            for _ in range(steps):
                fleet.fleet.dispatcher.step()
            fleet.crash("a")
            fleet.run_for(1.0)
            a = fleet.restart("a")
            fleet.run_for(20.0)
            assert fleet.agents["b"].running() == ["Circle"]
            assert a.running() == ["Home"], f"a died {steps} steps after COMMITTED"
            (account,) = a.ask(Migrations()).result
            assert (account["outcome"], account["winner"]) == ("moved", "b")
            # It has followed: who stops it has the last word.
            assert a.ask(Stop("Home")).ok
            fleet.crash("a")
            a = fleet.restart("a")
            fleet.run_for(1.0)
            assert a.running() == []


def test_a_task_that_is_to_follow_and_is_configured_no_more_is_named():
    with two() as fleet:
        moving(fleet, Phase.COMMITTED, then="Home")
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.start("a", tasks={"Circle": Circle})
        fleet.connect()
        fleet.run_for(20.0)
        assert fleet.agents["b"].running() == ["Circle"] and a.running() == []
        assert a.lines("error") == ["Home cannot follow: a/client has no such task at rest"]
        (account,) = a.ask(Migrations()).result
        assert account["outcome"] == "moved"


@pytest.mark.parametrize("wanted", [Phase.FROZEN, Phase.COMMITTED])
def test_the_account_says_that_the_source_was_started_anew(wanted):
    with two() as fleet:
        moving(fleet, wanted, then="Home")
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.restart("a")
        fleet.run_for(20.0)
        (account,) = a.ask(Migrations()).result
        (line,) = account["lines"]
        assert (account["asked_by"], account["cost"], line["peer"], line["cost"]) == ("a/test/Probe", "tasks", "b", 0.0)
        if wanted is Phase.FROZEN:
            assert (account["outcome"], account["winner"], line["fate"]) == ("stayed", "", "failed")
            assert account["reason"] == "a/client was started anew before b had the task"
            # It has not gone, so nothing follows.
            assert a.running() == ["Circle"]
        else:
            assert (account["outcome"], account["winner"], line["fate"]) == ("moved", "b", "won")
            assert account["reason"].startswith("a/client was started anew while the task was on its way")
        assert len(a.events("migration")) == 1


def test_what_a_rule_lets_follow_is_not_what_a_command_lets_follow():
    """A move that was asked for without `then` lets nothing follow, also where the task has a rule."""
    with FleetInTest(3, classes={"test.Circle": Circle, "test.Home": Home}) as fleet:
        rule = {"when": "battery", "below": 0.1, "then": "Home"}
        fleet.start("a", tasks={"Circle": {"type": Circle, "migrate": rule}, "Home": {"type": Home, "start": False}})
        fleet.start("b")
        fleet.connect()
        fleet.network.set_quality("a", "b", Quality(latency_s=0.01))
        moving(fleet, Phase.COMMITTED)
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.restart("a")
        fleet.run_for(10.0)
        assert fleet.agents["b"].running() == ["Circle"]
        assert a.running() == []


def fails():
    raise RuntimeError("a fault")


def restart_migrator(agent):
    agent.may_fail.add("network/TaskMigrator")
    agent.component("network/TaskMigrator").call(fails)


@pytest.mark.parametrize("wanted", [Phase.FROZEN, Phase.COMMITTED])
def test_a_migrator_that_is_started_anew_ends_no_hand_over(wanted):
    """Whoever asked hears how it really ended."""
    with two() as fleet:
        asked = moving(fleet, wanted, then="Home")
        a = fleet.agents["a"]
        restart_migrator(a)
        fleet.run_for(3.0)
        assert fleet.agents["b"].running() == ["Circle"] and a.running() == ["Home"]
        reply = a.reply_to(asked)
        assert reply.ok and reply.result["outcome"] == "moved"
        (account,) = a.ask(Migrations()).result
        assert account["outcome"] == "moved"
        assert account["reason"].startswith("the Task Migrator of a was started anew")


def test_a_migrator_that_is_started_anew_tells_who_waits_for_bids_that_they_are_lost():
    with two() as fleet:
        fleet.run_for(1.0)
        a = fleet.agents["a"]
        asked = a.publish(SYSCTRL, Migrate("Circle"))
        fleet.run_for(0.001)
        restart_migrator(a)
        assert a.reply_to(asked).reason == "the Task Migrator was started anew"
        # And it may be asked for again.
        assert a.ask(Migrate("Circle")).ok


def test_after_the_migrator_was_started_anew_a_hand_over_that_fails_ends_the_move():
    with two() as fleet:
        asked = moving(fleet, Phase.FROZEN)
        a = fleet.agents["a"]
        restart_migrator(a)
        fleet.crash("b")
        fleet.run_for(6.0)
        assert a.running() == ["Circle"]
        reply = a.reply_to(asked)
        assert not reply.ok and "did not say within" in reply.reason
        (account,) = a.ask(Migrations()).result
        assert account["outcome"] == "stayed" and "did not say within" in account["reason"]


@pytest.mark.parametrize("service", [Surveys, None])
def test_a_tombstone_belongs_to_the_service_that_wrote_it(service):
    """After a reboot too: it answers and forwards for a task that no configuration here names."""
    assert service is None or issubclass(service, Service)
    services = {"surveys": Surveys}
    home = "surveys" if service else "client"
    with FleetInTest(3, classes={"test.Circle": Circle}) as fleet:
        b = fleet.start("b", services=services)
        fleet.start("a", services=services, tasks={"Circle": {"type": Circle, "service": home}})
        fleet.connect()
        fleet.run_for(1.0)
        assert fleet.agents["a"].ask(Migrate(f"{home}/Circle")).ok
        fleet.start("c", services=services)
        fleet.connect()
        assert b.ask(Migrate(f"{home}/Circle", to="c")).ok
        fleet.crash("b")
        b = fleet.restart("b")
        fleet.run_for(1.0)
        both = {name: b.component(name) for name in ("client", "surveys")}
        found = {
            name: place.standing.record.phase
            for name, service in both.items()
            if isinstance(service, ClientService)
            if (place := service.places.get(TaskId("a", "Circle"))) is not None
        }
        assert found == {home: Phase.RELEASED}


@pytest.mark.parametrize("wanted", [Phase.FROZEN, Phase.COMMITTED])
def test_where_the_service_alone_is_started_anew_it_is_as_where_the_agent_is(wanted):
    with two() as fleet:
        moving(fleet, wanted, then="Home")
        a = fleet.agents["a"]
        a.may_fail.add("client")
        a.component("client").call(fails)
        fleet.run_for(20.0)
        *_, account = a.ask(Migrations()).result
        if wanted is Phase.FROZEN:
            assert a.running() == ["Circle"] and account["outcome"] == "stayed"
        else:
            assert a.running() == ["Home"] and account["outcome"] == "moved"
            assert fleet.agents["b"].running() == ["Circle"]
        assert "a/client was started anew" in account["reason"]


@pytest.mark.parametrize("negotiates", ["Owner", "Guardian"])
def test_a_service_whose_task_has_moved_hears_once_that_it_is_accounted_for(negotiates):
    with FleetInTest(3) as fleet:
        a = fleet.start("a", tasks={"Owner": Listens, "Guardian": Listens})
        fleet.start("b")
        fleet.connect()
        migrator: Any = a.component(MIGRATOR)
        owner: Any = a.component("client/Owner")
        asker: Any = a.component(f"client/{negotiates}")
        request = Solicit(TaskId("a", "Circle"), 1, "test.Circle", "", "client", (), "tasks", None, b"")
        migrator.on_receive(Negotiate(asker, request, "rule", "", False))
        migrator.on_receive(HasMoved(owner, request.task_id, "b", "1 a", None, ""))
        fleet.run_for(0.1)
        (over,) = owner.heard
        assert (over.task_id, over.reason) == (request.task_id, "")
