"""What follows a hand-over: `then`, and the account. Neither is forgotten if an agent is started again in between."""

from typing import Any

import pytest
from seeded import for_each
from services.sequels import Circle, Home, follows_after_a_death, moving, two

from pancakes.control import Migrate, Migrations
from pancakes.durable.bidding_messages import MIGRATOR, HasMoved, MoveOver, Negotiate
from pancakes.durable.client_service import ClientService, ClientServiceCore
from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.service import Service
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task
from pancakes.testing import Fleet


class Listens(TaskCore, Task):
    """Keeps what it is told."""

    __module__ = "pancakes"  # its names are Pancakes' own

    def on_start(self):
        self.heard = []

    def take_message(self, message):
        if isinstance(message, MoveOver):
            self.heard.append(message)
            return None
        return super().take_message(message)


class Surveys(ClientService):
    """A service of a user's own."""


def test_sequel_follows_once_wherever_the_source_dies():
    """It dies some steps after the point of no return; `test_sequel_full.py` tries each step."""
    for_each(range(0, 60, 7), follows_after_a_death)


def test_sequel_that_is_configured_no_more_is_named():
    with two() as fleet:
        moving(fleet, Standing.YIELDED, then="Home")
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.start("a", tasks={"Circle": Circle})
        fleet.connect()
        fleet.run_for(20.0)
        assert fleet.agents["b"].running() == ["Circle"] and a.running() == []
        assert a.lines("error") == ["Home cannot follow: a/client has no such task at rest"]
        (account,) = a.ask(Migrations()).result
        assert account["outcome"] == "moved"


@pytest.mark.parametrize("wanted", [Standing.OFFERED, Standing.YIELDED])
def test_account_after_a_restart_of_the_source(wanted):
    with two() as fleet:
        moving(fleet, wanted, then="Home")
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.restart("a")
        fleet.run_for(20.0)
        (account,) = a.ask(Migrations()).result
        (line,) = account["lines"]
        assert (account["asked_by"], account["cost"], line["peer"], line["cost"]) == ("a/test/Probe", "tasks", "b", 0.0)
        if wanted is Standing.OFFERED:
            assert (account["outcome"], account["winner"], line["fate"]) == ("stayed", "", "failed")
            assert account["reason"] == "a/client was started again before b had the task"
            # It has not gone, so nothing follows.
            assert a.running() == ["Circle"]
        else:
            assert (account["outcome"], account["winner"], line["fate"]) == ("moved", "b", "won")
            assert account["reason"].startswith("a/client was started again while the task was on its way")
        assert len(a.events("migration")) == 1


def test_sequel_of_a_rule_is_not_that_of_a_command():
    """A move that was asked for without `then` lets nothing follow, also where the task has a rule."""
    with Fleet(3, classes={"test.Circle": Circle, "test.Home": Home}) as fleet:
        rule = {"when": "battery", "below": 0.1, "then": "Home"}
        fleet.start("a", tasks={"Circle": {"type": Circle, "migrate": rule}, "Home": {"type": Home, "start": False}})
        fleet.start("b")
        fleet.connect()
        fleet.network.set_quality("a", "b", Quality(latency_s=0.01))
        moving(fleet, Standing.YIELDED)
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


@pytest.mark.parametrize("wanted", [Standing.OFFERED, Standing.YIELDED])
def test_hand_over_outlives_a_restart_of_the_migrator(wanted):
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
        assert account["reason"].startswith("the Task Migrator of a was started again")


def test_bids_are_lost_if_the_migrator_restarts():
    with two() as fleet:
        fleet.run_for(1.0)
        a = fleet.agents["a"]
        asked = a.publish(SYSCTRL, Migrate("Circle"))
        fleet.run_for(0.001)
        restart_migrator(a)
        assert a.reply_to(asked).reason == "the Task Migrator was started again"
        # And it may be asked for again.
        assert a.ask(Migrate("Circle")).ok


def test_failed_hand_over_after_a_restart_of_the_migrator():
    with two() as fleet:
        asked = moving(fleet, Standing.OFFERED)
        a = fleet.agents["a"]
        restart_migrator(a)
        fleet.crash("b")
        fleet.run_for(6.0)
        assert a.running() == ["Circle"]
        reply = a.reply_to(asked)
        assert not reply.ok and "did not ask for the task within" in reply.reason
        (account,) = a.ask(Migrations()).result
        assert account["outcome"] == "stayed" and "did not ask for the task within" in account["reason"]


@pytest.mark.parametrize("service", [Surveys, None])
def test_tombstone_belongs_to_the_service_that_wrote_it(service):
    """After a reboot too: it answers and forwards for a task that no configuration here names."""
    assert service is None or issubclass(service, Service)
    services = {"surveys": Surveys}
    home = "surveys" if service else "client"
    with Fleet(3, classes={"test.Circle": Circle}) as fleet:
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
            name: place.record.standing
            for name, service in both.items()
            if isinstance(service, ClientServiceCore)
            if (place := service.places.get(TaskId("a", "Circle"))) is not None
        }
        assert found == {home: Standing.RELEASED}


@pytest.mark.parametrize("wanted", [Standing.OFFERED, Standing.YIELDED])
def test_sequel_after_a_restart_of_the_service_only(wanted):
    with two() as fleet:
        moving(fleet, wanted, then="Home")
        a = fleet.agents["a"]
        a.may_fail.add("client")
        a.component("client").call(fails)
        fleet.run_for(20.0)
        *_, account = a.ask(Migrations()).result
        # The register is the agent's, not the service's: the migration goes on meanwhile.
        assert a.running() == ["Home"] and account["outcome"] == "moved"
        assert fleet.agents["b"].running() == ["Circle"]
        assert "a/client was started again" in account["reason"]


@pytest.mark.parametrize("negotiates", ["Owner", "Guardian"])
def test_service_hears_once_that_its_move_is_accounted(negotiates):
    with Fleet(3) as fleet:
        a = fleet.start("a", tasks={"Owner": Listens, "Guardian": Listens})
        fleet.start("b")
        fleet.connect()
        migrator: Any = a.component(MIGRATOR)
        owner: Any = a.component("client/Owner")
        asker: Any = a.component(f"client/{negotiates}")
        request = Solicit(TaskId("a", "Circle"), 1, "test.Circle", "", "client", (), "tasks", None, b"")
        migrator.take_message(Negotiate(asker, request, "rule", "", False))
        migrator.take_message(HasMoved(owner, request.task_id, "b", "1 a", None, ""))
        fleet.run_for(0.1)
        (over,) = owner.heard
        assert (over.task_id, over.reason) == (request.task_id, "")
