"""What an agent says it could be to a task from elsewhere, from its records and its tables."""

from __future__ import annotations

import pytest
from services.counting import Count

from pancakes.control import Migrate, Stop
from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.testing import Fleet

COUNT = {"Count": {"type": "test.Count"}}


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        yield made


def request_of(birthplace):
    return Solicit(TaskId(birthplace, "Count"), 1, "test.Count", "", "client")


def refusal(agent, birthplace):
    """Returns why an agent would not take the task of another."""
    refusal = agent.agent.host_state.refusal_of(birthplace, request_of(birthplace))
    return refusal.text if refusal is not None else ""


def test_a_name_belongs_to_the_task_that_has_come_and_no_more_once_it_has_left(fleet):
    a = fleet.start("a", tasks=COUNT)
    b, c = fleet.start("b"), fleet.start("c", tasks=COUNT)
    fleet.connect()
    fleet.run_for(0.5)
    assert refusal(b, "a") == refusal(b, "c") == ""
    assert refusal(a, "c") == "has a task named Count already (a/Count)"
    assert c.ask(Migrate("Count", to="b")).ok
    assert refusal(b, "c") == "" and refusal(b, "a") == "has a task named Count already (c/Count)"
    assert b.ask(Migrate("Count", to="c")).ok
    fleet.run_for(1.0)
    assert refusal(b, "a") == "" and refusal(c, "a") == "has a task named Count already (c/Count)"
    assert a.ask(Migrate("Count", to="b")).ok
    assert refusal(b, "c") == "has a task named Count already (a/Count)", "whatever was here before"


def test_a_name_is_taken_by_a_task_for_which_a_slot_is_kept(fleet):
    fleet.start("a")
    b = fleet.start("b")
    fleet.connect()
    request = request_of("a")
    assert b.agent.host_state.reserve("a", request) is None
    assert refusal(b, "c") == "has a task named Count already (a/Count)" and refusal(b, "a") == ""
    b.agent.host_state.free(request.task_id)
    assert refusal(b, "c") == ""
    assert b.agent.host_state.reserve("a", request) is None
    fleet.run_for(4.9)
    assert b.agent.host_state.is_expected("a", request.task_id) and not b.agent.host_state.is_expected(
        "c", request.task_id
    )
    fleet.run_for(0.2)
    assert not b.agent.host_state.is_expected("a", request.task_id) and refusal(b, "c") == ""


def test_a_hand_off_keeps_its_own_service_from_being_stopped_and_no_other(fleet):
    a = fleet.start("a", tasks=COUNT, services={"second": {"type": "client"}})
    fleet.start("b")
    fleet.connect()
    asked = a.publish("sysctrl", Migrate("Count"))
    assert fleet.run_until(lambda: a.agent.host_state.under_way() != [])
    assert a.agent.host_state.under_way("client") == [TaskId("a", "Count")]
    assert a.agent.host_state.under_way("second") == []
    assert a.ask(Stop("second", dry_run=True)).ok
    assert a.reply_to(asked).ok
