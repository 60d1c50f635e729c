"""What a plug-in gets wrong in the root's own turns costs a refusal, or ends the agent in order; all are answered."""

import sys
from typing import Any, ClassVar

import pytest

from pancakes.control import Describe, Reply, Restart, Start, Stop
from pancakes.devices import Load
from pancakes.devices.driver import Actuator
from pancakes.durable.client_service import ClientService
from pancakes.events import Event
from pancakes.kernel.actor import Component
from pancakes.kernel.handlers import on
from pancakes.service import Service
from pancakes.supervision.service_core import ServiceCore
from pancakes.task import Task, every
from pancakes.testing import AgentHandle, Fleet, no_thread_left, threaded_agent


class Count(Task):
    """Counts its ticks, and says so when it ends."""

    @every(hz=10)
    def tick(self, tick):
        pass

    def on_stop(self):
        self.event("counted")


class RefusesBadly(Service):
    """Its `refuse_stop` is wrong."""

    @classmethod
    def refuse_stop(cls, kernel, name, arguments, for_s):
        raise KeyError("battery")


class KeepsBadly(ServiceCore, Service):
    """Its `keep` is wrong."""

    __module__ = "pancakes"  # its names are Pancakes' own

    def keep(self):
        raise KeyError("cells")


class FailsBadly(ClientService):
    """It fails when it sees a load, and its `on_failure` does nothing."""

    @on("system", Load)
    def load(self, packet):
        raise RuntimeError("too much")

    def on_failure(self, exception_type, exception_value, traceback):
        pass


class Exits(Service):
    """It ends the actor that asks it whether it may stop, the root, just when that is asked for something else."""

    running: ClassVar[Component]

    @classmethod
    def refuse_stop(cls, kernel, name, arguments, for_s):
        Exits.running.publish("sysctrl", Describe())
        sys.exit(3)

    def on_start(self):
        Exits.running = self

    @on("sysctrl", Reply, addressed=True)
    def on_answer(self, packet):
        self.event("answered", reason=packet.body.reason)


class Wheels(Actuator):
    """Says on `log` when it holds and when it is closed."""

    type = "motors"

    def write(self, command, valid_s, source):
        pass

    def safe_stop(self):
        self.context.log("info", "stands")


class Driving(Count):
    """Holds the wheels."""

    requires = ("motors",)


def replies(agent: AgentHandle, *bodies: object) -> list[str]:
    """Asks for several things at once; returns what each was refused for, an empty string where it was done."""
    asked = [agent.publish("sysctrl", body) for body in bodies]
    return [agent.reply_to(packet).reason for packet in asked]


def with_service(fleet: Fleet, cls: type, **others: Any) -> AgentHandle:
    tasks = {"Count": {"type": Count, "service": "own"}}
    return fleet.start("a", services={"own": cls}, tasks=tasks, **others)


def test_a_refuse_stop_that_fails_is_the_answer_also_to_a_command_that_has_waited():
    with Fleet() as fleet:
        agent = with_service(fleet, RefusesBadly)
        reasons = replies(agent, Stop("own"), Restart("own"), Stop("own"), Stop("own"))
        assert reasons[1] == ""
        for reason in (reasons[0], *reasons[2:]):
            assert "asked for failed: KeyError: 'battery' at test_root_failures.py:" in reason
        assert agent.ask(Describe()).ok


def test_a_keep_that_fails_costs_what_the_tasks_carried_and_not_the_agent():
    with Fleet() as fleet:
        agent = with_service(fleet, KeepsBadly)
        assert agent.ask(Stop("own")).ok
        assert any(
            "what the tasks of a/own carried is lost: KeyError: 'cells'" in line for line in agent.lines("error")
        )
        assert agent.ask(Start("own")).ok
        assert agent.running("own") == ["Count"]


def test_who_waits_for_a_service_is_answered_whatever_its_on_failure_does():
    with Fleet() as fleet:
        agent = with_service(fleet, FailsBadly)
        asked = [agent.publish("sysctrl", body) for body in (Stop("Count"), Start("Count"))]
        agent.wait_for_event("asked", what="stop")
        agent.publish("system", Load(0.0))
        reasons = [agent.reply_to(packet).reason for packet in asked]
        assert reasons[1].startswith("a/own failed before it had done that: RuntimeError: too much")


def test_a_service_that_fails_on_a_command_answers_it_once():
    class Fails(ServiceCore, Service):
        __module__ = "pancakes"  # its names are Pancakes' own

        def carry_out_command(self, body, slot, request):
            raise RuntimeError("no map")

    with Fleet() as fleet:
        agent = with_service(fleet, Fails)
        asked = agent.publish("sysctrl", Describe("own/Count"))
        assert agent.reply_to(asked).reason.startswith("a/own failed before it had done that: RuntimeError: no map")
        agent.wait_for_event("service_started", service="own")
        fleet.run_for(1.0)
        assert len([packet for packet in agent.probe.packets() if packet.cause == (asked.source, asked.seq)]) == 1


def test_a_service_that_exits_where_it_is_made_fails_alone():
    class Made(Service):
        def __init__(self, *args, **others):
            super().__init__(*args, **others)
            sys.exit(3)

    with Fleet() as fleet:
        agent = fleet.start("a", services={"own": Made}, tasks={"Other": Count})
        agent.wait_for_event("service_failed", service="own")
        fleet.run_for(1.0)
        assert agent.running() == ["Other"]


@pytest.mark.parametrize("from_elsewhere", [False, True])
def test_a_root_that_fails_ends_the_agent_and_answers_all_who_asked(from_elsewhere: bool):
    with Fleet() as fleet:
        agent = with_service(fleet, Exits)
        asker = fleet.start("b") if from_elsewhere else agent
        fleet.connect()
        reasons: list[str] = []
        agent.agent.on_fatal(reasons.append)
        asked = [asker.publish("sysctrl", body, "a") for body in (Restart("own"), Stop("own"), Stop("own"))]

        answers = [asker.reply_to(packet).reason for packet in asked]
        answers.append(agent.wait_for_event("answered")["reason"])

        why = "a/kernel, which starts and watches the services, has failed: SystemExit: 3 at test_root_failures.py:"
        assert "" in answers
        assert all(answer.startswith(f"a ends: {why}") for answer in answers if answer), answers
        assert len(reasons) == 1 and reasons[0].startswith(why)
        assert any(line.startswith(why) for line in agent.lines("error"))


def test_the_agent_of_a_root_that_failed_ends_in_order():
    with Fleet() as fleet:
        agent = fleet.start(
            "a", services={"own": Exits}, tasks={"Driving": Driving}, devices={"wheels": {"type": Wheels}}
        )
        agent.ask(Stop("own"))
        agent.wait_until(lambda: agent.component("log") is None)
        order = [packet.source for packet in agent.probe.packets(Event, lambda event: event.kind == "task_stopped")]
        assert order.index("a/client") < order.index("a/network") < order.index("a/device")
        assert agent.events("counted")
        assert "wheels: stands" in agent.lines("info")


@pytest.mark.parametrize("name", ["own", "closer"])
def test_an_agent_on_threads_whose_root_failed_leaves_no_thread(name):
    with no_thread_left(), threaded_agent("a", services={name: Exits}, tasks={"Driving": Count}) as agent:
        assert not agent.ask(Stop(name)).ok
        agent.wait_until(lambda: bool(agent.agent.fatal))
    assert agent.still_running() == []
