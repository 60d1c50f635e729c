"""The findings of `pancakes doctor` about tasks and services that a person has stopped."""

import pytest

from pancakes.control import Describe, Start, Stop
from pancakes.service import Service
from pancakes.task import Task
from pancakes.testing import Fleet
from pancakes.tools.cli.verbs.agent_checks import check_agents
from pancakes.tools.cli.verbs.checks import Facts


class Plain(Service):
    """A service that keeps no records of its tasks."""


class Blind(Task):
    """Requires a missing device."""

    requires = ("pose",)


@pytest.fixture
def agent(tmp_path):
    with Fleet() as fleet:
        tasks = {name: {"type": Task, "service": service} for name, service in (("Home", "client"), ("Odd", "plain"))}
        tasks["Blind"] = {"type": Blind, "service": "plain", "start": False}
        yield fleet.start(
            "a", tasks=tasks, devices={"load": {"type": "host.load", "rate_hz": 1.0}}, services={"plain": Plain}
        )


def findings(agent):
    found = check_agents(Facts([agent.ask(Describe()).result]))
    return [(finding.level, finding.about, finding.text, finding.advice) for finding in found]


def test_stopped_tasks_and_devices_are_in_order(agent):
    assert [row[:2] for row in findings(agent)] == [("ok", "a")]
    for target in ("client/Home", "plain/Odd", "device/load"):
        assert agent.ask(Stop(target)).ok
    assert [row[:2] for row in findings(agent)] == [("ok", "a")]


def test_refused_start_does_not_affect_other_findings(agent):
    assert not agent.ask(Start("Blind")).ok
    assert [row[:2] for row in findings(agent)] == [("ok", "a")]


def test_stopped_service_is_reported_with_the_requester(agent):
    assert agent.ask(Stop("plain")).ok
    (found,) = findings(agent)
    assert found[:2] == ("warning", "a/plain")
    assert "asked for by " in found[2] and "pancakes service start a/plain" in found[3]
    assert agent.ask(Start("plain")).ok
    assert [row[:2] for row in findings(agent)] == [("ok", "a")]


def test_task_that_waits_for_a_device_is_reported():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blind": {"type": Blind, "service": "plain"}}, services={"plain": Plain})
        found = findings(agent)
    assert ("warning", "a/Blind") in [row[:2] for row in found]


class Boom(Task):
    def on_start(self):
        raise ValueError("the wheel came off")


def test_given_up_task_is_reported_until_it_is_stopped():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Boom": {"type": Boom, "restart": {"at_most": 1}}})
        fleet.run_for(5.0)
        assert [row[:2] for row in findings(agent)] == [("error", "a/Boom")]
        assert agent.ask(Stop("Boom")).ok
        assert [row[:2] for row in findings(agent)] == [("ok", "a")]
