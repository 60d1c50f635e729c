"""Tasks that an agent knows and does not run: it says which, and why, when it starts and when it is asked."""

from __future__ import annotations

import pytest

from pancakes.control import Describe, Migrate, Start, Stop
from pancakes.durable.record import Record, TaskId, rest_of
from pancakes.durable.register import NOBODY, Epoch, Identity, Register
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Walk(Task):
    @every(hz=10)
    def tick(self, tick):
        pass


class Break(Task):
    @every(hz=10)
    def tick(self, tick):
        raise RuntimeError("broken")


@pytest.fixture
def fleet():
    with Fleet(seed=4) as made:
        yield made


def rest(agent, task):
    described = {row["task"]: row for row in agent.ask(Describe()).result["tasks"]}
    return described[task]["state"], described[task]["rest"]


def said(agent):
    return [line for line in agent.lines("warning") if "does not start" in line]


def test_a_task_that_moved_away_says_where_it_is(fleet):
    a, b = fleet.start("a", tasks={"Walk": Walk}), fleet.start("b", tasks={"Other": {"type": Walk, "start": False}})
    fleet.run_for(1.0)
    assert a.ask(Migrate("Walk", to="b")).ok
    fleet.run_for(1.0)
    assert rest(a, "Walk") == ("stopped", "moved → b")
    assert rest(b, "Walk") == ("running", "")
    assert rest(b, "Other") == ("stopped", "")

    fleet.stop("a")
    a = fleet.restart("a")
    fleet.run_for(1.0)

    assert said(a) == ["a/client/Walk does not start: moved → b"]
    assert rest(a, "Walk") == ("stopped", "moved → b")
    fleet.stop("b")
    assert said(fleet.restart("b")) == [], "a task that came and runs, and one that its file does not start"


def test_a_task_that_was_stopped_says_so_until_it_is_started(fleet):
    agent = fleet.start("a", tasks={"Walk": Walk})
    assert agent.ask(Stop("Walk")).ok
    fleet.stop("a")
    agent = fleet.restart("a")
    fleet.run_for(1.0)
    assert said(agent) == ["a/client/Walk does not start: stopped"]
    assert rest(agent, "Walk") == ("stopped", "stopped")

    assert agent.ask(Start("Walk")).ok
    assert rest(agent, "Walk") == ("running", "")
    fleet.stop("a")
    assert said(fleet.restart("a")) == []


def test_a_task_that_was_given_up_says_so(fleet):
    fleet.start("a", tasks={"Break": {"type": Break, "restart": {"policy": "no"}}})
    fleet.run_for(1.0)
    fleet.stop("a")
    agent = fleet.restart("a")
    fleet.run_for(1.0)

    assert said(agent) == ["a/client/Break does not start: failed"]
    assert rest(agent, "Break") == ("stopped", "failed")


def test_a_task_that_came_home_runs_and_says_nothing(fleet):
    a, b = fleet.start("a", tasks={"Walk": Walk}), fleet.start("b")
    for agent, to in ((a, "b"), (b, "a")):
        fleet.run_for(1.0)
        assert agent.ask(Migrate("Walk", to=to)).ok
    fleet.run_for(1.0)
    fleet.stop("a")
    a = fleet.restart("a")
    fleet.run_for(1.0)

    assert said(a) == []
    assert rest(a, "Walk") == ("running", "")


def test_a_task_that_was_forgotten_says_so():
    assert rest_of(Record(TaskId("a", "Count"), Register(Epoch(3, NOBODY)), me=Identity("a"))) == "forgotten"
    assert rest_of(Record(TaskId("a", "Count"))) == "", "one that was never here may be born"
