"""What an agent remembers of the claims of others: the highest on each task, and of so many tasks."""

from __future__ import annotations

import pytest

from pancakes.durable import ownership
from pancakes.durable.ownership import Claims, OwnerClaim, claims_of, in_packets
from pancakes.durable.record import Epoch, Phase, Record, TaskId


def claimed(name: str, epoch: int) -> OwnerClaim:
    return OwnerClaim(TaskId("a", name), Epoch(epoch, "a"))


def test_the_highest_claim_on_a_task_counts_and_of_two_equal_ones_the_later() -> None:
    claims = Claims()
    claims.heard("b", claimed("Scan", 3))
    claims.heard("c", claimed("Scan", 2))
    assert claims.of(TaskId("a", "Scan")) == ("b", claimed("Scan", 3))
    claims.heard("c", claimed("Scan", 3))
    assert claims.by_peer() == {"c": {TaskId("a", "Scan"): claimed("Scan", 3)}}
    assert claims.of(TaskId("b", "Scan")) is None


def test_of_too_many_tasks_the_first_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "MOST", 2)
    claims = Claims()
    for name in ("One", "Two"):
        claims.heard("b", claimed(name, 1))
    assert len(claims.by_peer()["b"]) == 2
    claims.heard("b", claimed("Three", 1))
    assert [task_id.name for task_id in claims.by_peer()["b"]] == ["Two", "Three"]


def test_what_is_at_rest_for_a_hand_off_is_owned_still_and_what_was_given_away_is_not() -> None:
    records = [Record(TaskId("a", phase.value), phase, epoch=Epoch(1, "a")) for phase in Phase]
    assert [it.task_id.name for it in claims_of(records)] == [Phase.OWNER.value, Phase.FROZEN.value]


def test_many_claims_take_several_packets() -> None:
    claims = [claimed(f"Scan{n}", n) for n in range(ownership.IN_ONE_PACKET + 1)]
    first, second = in_packets(claims)
    assert (*first.claims, *second.claims) == tuple(claims) and len(second.claims) == 1
    assert list(in_packets([])) == []
