"""Two tasks that need one actuator are started in the same moment: what is told of each is true."""

import pytest

from pancakes.control import Start, Stop
from pancakes.durable.record import TaskId
from pancakes.durable.register import Wanted
from pancakes.packet import SYSCTRL
from pancakes.task import Task
from pancakes.testing import Fleet


class Circle(Task):
    requires = ("motors",)


class Home(Circle):
    pass


@pytest.fixture
def fleet():
    with Fleet(7, classes={"test.Circle": Circle, "test.Home": Home}) as made:
        yield made


def started(fleet, start):
    tasks = {"Circle": {"type": Circle, "start": start}, "Home": {"type": Home, "start": start}}
    return fleet.start("a", devices={"wheels": "null.motors"}, tasks=tasks)


def wanted(agent, name):
    return agent.component("client").places[TaskId("a", name)].record.wanted


def test_of_two_that_are_asked_for_the_second_is_refused_and_stays_at_rest(fleet):
    """Before, its record said that it was wanted: it ran, unasked for, as soon as the first one stopped."""
    a = started(fleet, start=False)
    for name in ("Circle", "Home"):  # each has run before
        assert a.ask(Start(name)).ok
        assert a.ask(Stop(name)).ok
    first, second = (a.publish(SYSCTRL, Start(name)) for name in ("Circle", "Home"))
    assert a.reply_to(first).ok
    refused = a.reply_to(second)
    assert not refused.ok and "wheels is kept for a/client/Circle, which is about to start" in refused.reason
    assert a.running() == ["Circle"] and wanted(a, "Home") is Wanted.STOPPED
    assert a.ask(Stop("Circle")).ok
    fleet.run_for(5.0)
    assert a.running() == []
    # It is free, and nothing of the refusal has stayed.
    assert a.ask(Start("Home")).ok


def test_a_start_that_the_journal_cannot_write_keeps_its_actuators_for_the_next_try(fleet):
    a = started(fleet, start=False)
    end = fleet.faults.fill_disk("a")
    asked = a.publish(SYSCTRL, Start("Circle"))
    fleet.run_for(0.1)
    assert not a.ask(Start("Home")).ok
    end()
    assert a.reply_to(asked).ok
    assert a.running() == ["Circle"]


def test_of_two_that_start_with_the_agent_the_second_follows_when_it_can(fleet):
    """Both are wanted, by the configuration: the first start of all is no different from every later one."""
    a = started(fleet, start=True)
    fleet.run_for(1.0)
    assert a.running() == ["Circle"]
    fleet.crash("a")
    a = fleet.restart("a")
    assert a.running() == ["Circle"]
    assert a.ask(Stop("Circle")).ok
    fleet.run_for(2.0)
    assert a.running() == ["Home"]
