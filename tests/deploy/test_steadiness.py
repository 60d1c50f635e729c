"""Deciding whether the tasks of a restarted agent run well."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.client import TaskInfo
from pancakes.tools.deploy.drain import Steadiness


def row(state: str = "running", incarnation: int = 1, task: str = "T", reason: str = "", rest: str = "") -> TaskInfo:
    who = TaskInfo(agent="a", service="client", task=task, type="x", state=state)
    return replace(who, reason=reason, rest=rest, incarnation=incarnation)


def test_tasks_must_run_undisturbed():
    steadiness = Steadiness({}, calm_s=2.0)
    assert [steadiness.look([row()], now_s) for now_s in (0.0, 1.0, 1.9, 2.0)] == [False, False, False, True]


def test_a_restarted_task_restarts_the_wait():
    steadiness = Steadiness({}, calm_s=2.0)
    steadiness.look([row()], 0.0)
    assert not steadiness.look([row(incarnation=2)], 2.0)
    assert not steadiness.look([row("restarting", 2)], 4.0)
    assert not steadiness.look([row(incarnation=3)], 4.5)
    assert not steadiness.look([row(incarnation=3)], 6.0)
    assert steadiness.look([row(incarnation=3)], 6.5)


def test_task_that_ran_before_must_run():
    tasks = [
        row("failed", reason="no legs"),
        row("refused", task="Scan", reason="lacks sonar"),
        row("stopped", task="U"),
    ]
    assert Steadiness({}, 1.0).faults(tasks) == ["client/T is failed: no legs", "client/Scan is refused: lacks sonar"]
    before = {"client/Scan": "refused", "client/T": "running"}
    assert Steadiness(before, 1.0).faults(tasks) == ["client/T is failed: no legs"]
    assert Steadiness(before, 1.0).is_hopeless(tasks)
    assert not Steadiness(before, 1.0).is_hopeless(tasks[1:])
    assert not Steadiness({"client/T": "failed"}, 1.0).is_hopeless(tasks)


def test_task_given_up_earlier_counts_as_failed():
    tasks = [row("stopped", rest="failed")]
    assert Steadiness({}, 1.0).faults(tasks) == ["client/T is failed"] and Steadiness({}, 1.0).is_hopeless(tasks)
