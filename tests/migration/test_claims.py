"""What an agent remembers of the claims of others: of each its highest one on each task, and a limited number."""

from __future__ import annotations

import pytest

from pancakes.durable import answers
from pancakes.durable.answers import Claims
from pancakes.durable.messages import Fact
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register


def claimed(name: str, number: int) -> Fact:
    owner = Identity("b")
    return Fact(TaskId("a", name), Register(Epoch(number, owner), 0, ((owner,),)))


def test_claims_keep_the_highest_on_each_task() -> None:
    claims = Claims()
    claims.heard("b", claimed("Scan", 3))
    claims.heard("b", claimed("Scan", 2))
    claims.heard("c", claimed("Scan", 1))
    task_id = TaskId("a", "Scan")
    assert claims.by_peer() == {"b": {task_id: claimed("Scan", 3)}, "c": {task_id: claimed("Scan", 1)}}


def test_claims_on_too_many_tasks_forget_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "MOST_CLAIMS", 2)
    claims = Claims()
    for name in ("One", "Two", "Three"):
        claims.heard("b", claimed(name, 1))
    assert [task_id.name for task_id in claims.by_peer()["b"]] == ["Two", "Three"]


def test_claims_of_too_many_agents_forget_the_most_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "MOST_AGENTS", 2)
    claims = Claims()
    for peer in ("b", "c", "b", "d"):
        claims.heard(peer, claimed("Scan", 1))
    assert list(claims.by_peer()) == ["b", "d"]
