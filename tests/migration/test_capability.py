"""Whether an agent can take a task at all."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.messages import Solicit
from pancakes.durable.negotiation import Capability, compatible
from pancakes.durable.record import TaskId
from pancakes.migration import ActiveTasks, CostFacts, HostLoad

SCAN = TaskId("agent1", "ScanTarget")
REQUEST = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.2", "client", ("pose", "motors"), moves_on_below=0.65)
ROBOT = Capability(
    devices=("battery", "ir", "motors", "pose", "sonar"),
    version="0.1.0",
    battery_level=0.99,
)


def test_a_robot_with_all_that_is_asked_for_refuses_nothing() -> None:
    assert ROBOT.refusal_of(REQUEST) is None


@pytest.mark.parametrize(
    ("changes", "reason", "code"),
    [
        ({"devices": ("motion", "pose")}, "lacks the device type motors", "unsupported"),
        ({"devices": ()}, "lacks the device types pose, motors", "unsupported"),
        ({"version": None}, "knows no task type 'encirclement.ScanTarget'", "unsupported"),
        (
            {"version": None, "fault": "it cannot be loaded: no camera"},
            "loaded: no camera",
            "unsupported",
        ),
        (
            {"version": "0.2.0"},
            "has encirclement.ScanTarget in version 0.2.0, not 0.1.2",
            "unsupported",
        ),
        ({"holder": TaskId("agent2", "ScanTarget")}, "has a task named ScanTarget already", "conflict"),
        ({"battery_level": 0.74}, "has 74% of its battery", "unable"),
        ({"role": "environment"}, "is no host of tasks but in the role 'environment'", "unsupported"),
        ({"costs": ()}, "knows no cost function 'tasks'", "unsupported"),
        (
            {"services": ("guide", "map")},
            "runs no service 'client' that takes tasks in, only guide, map",
            "unsupported",
        ),
        ({"services": ()}, "runs no service 'client' that takes tasks in, nor any other", "unsupported"),
        (
            {"recorded": "map"},
            "has a record of agent1/ScanTarget in its service 'map', not in 'client'",
            "unsupported",
        ),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_what_is_lacking_is_said(changes: dict[str, object], reason: str, code: str) -> None:
    refusal = replace(ROBOT, **changes).refusal_of(REQUEST)
    assert refusal is not None and reason in refusal.text and refusal.code == code


def test_all_reasons_are_given_at_once() -> None:
    assert Capability().refusal_of(REQUEST) == Refusal(
        "unsupported", "lacks the device types pose, motors; knows no task type 'encirclement.ScanTarget'"
    )


def test_the_name_of_the_task_itself_is_no_hindrance() -> None:
    assert replace(ROBOT, holder=SCAN).refusal_of(REQUEST) is None


def test_a_task_without_a_battery_rule_may_go_anywhere() -> None:
    assert replace(ROBOT, battery_level=0.01).refusal_of(replace(REQUEST, moves_on_below=None)) is None
    assert replace(ROBOT, battery_level=None).refusal_of(REQUEST) is None
    assert replace(ROBOT, battery_level=0.75).refusal_of(REQUEST) is None


@pytest.mark.parametrize(
    ("offered", "here", "may"),
    [
        ("1.4.0", "1.9", True),
        ("1.4.0", "2.0.0", False),
        ("0.1.2", "0.1.9", True),
        ("0.1", "0.2", False),
        ("", "", True),
    ],
)
def test_versions(offered: str, here: str, may: bool) -> None:
    assert compatible(offered, here) is may


def test_the_paper_s_cost_is_the_number_of_active_tasks() -> None:
    cost = ActiveTasks()
    assert cost.terms(CostFacts(HostLoad(active_tasks=3))) == {"active tasks": 3.0}
    assert cost(CostFacts(HostLoad(active_tasks=3))) == 3.0


@pytest.mark.parametrize(
    ("reserve_s", "least_s", "why"),
    [
        (60.0, 30.0, ""),
        (59.0, 30.0, "has a reserve of 59 s, too near to the 30 s at which the task would move on"),
        (0.0, 0.0, "must go to a dock itself: its reserve is 0 s"),
        (None, 30.0, "its reserve is not known: a task of the type energy.reserve tells it"),
        (None, None, ""),
        (-5.0, None, ""),
    ],
)
def test_a_robot_needs_twice_the_reserve_at_which_the_task_would_move_on(
    reserve_s: float | None, least_s: float | None, why: str
) -> None:
    refusal = replace(ROBOT, reserve_s=reserve_s).refusal_of(replace(REQUEST, least_reserve_s=least_s))
    assert (refusal.text if refusal is not None else "") == why


def test_what_has_no_battery_needs_no_reserve() -> None:
    on_mains = replace(ROBOT, devices=("motors", "pose"), battery_level=None)
    assert on_mains.refusal_of(replace(REQUEST, least_reserve_s=30.0)) is None
