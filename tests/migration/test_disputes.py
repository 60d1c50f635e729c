"""Of a task that two agents own: what the core decides, row by row."""

from __future__ import annotations

import pytest
from migration.handoff_samples import ABSENT, ASKED, COMMITTED, FROZEN, OWNER, PREPARED, RELEASED, RUNNING
from msgspec.structs import replace

from pancakes.durable.handoff import handle, recover
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    AttemptFailed,
    ClaimHeard,
    Decline,
    Discard,
    Effect,
    Ended,
    Event,
    ForgettingAsked,
    GiveWay,
    Persist,
    PersistFailed,
    Remember,
    RunAsked,
    StartTask,
)
from pancakes.durable.ownership import IN_ONE_PACKET, MOST, Claims, OwnerClaim, claims_of, in_packets
from pancakes.durable.record import Epoch, Phase, Record, TaskId, Volatile, Wanted, rest_of

ME = "agent1"
HIGHER = Epoch(OWNER.epoch.n + 3, "agent3")
DISPUTED = replace(OWNER, wanted=Wanted.DISPUTED, peer="agent3", seen=HIGHER)
AT_REST = Volatile()


def at(record: Record, volatile: Volatile, event: Event) -> list[Effect]:
    return handle(ME, record, volatile, event)


@pytest.mark.parametrize("epoch", [HIGHER, OWNER.epoch], ids=["higher", "the same"])
def test_an_owner_that_hears_of_one_with_as_high_a_right_stands_still_and_then_writes_it_down(epoch: Epoch) -> None:
    own = replace(DISPUTED, seen=max(OWNER.seen, epoch))
    remember, still, persist, settled = at(OWNER, RUNNING, ClaimHeard("agent3", epoch))
    assert isinstance(still, GiveWay) and "agent1/ScanTarget is owned by agent3 too" in still.reason
    assert (remember, persist, settled) == (Remember(Volatile(again=own)), Persist(own), Remember(AT_REST))


def test_a_hand_off_that_is_asked_for_comes_to_nothing() -> None:
    effects = at(OWNER, ASKED, ClaimHeard("agent3", HIGHER))
    assert any(isinstance(effect, AttemptFailed) and effect.peer == "agent2" for effect in effects)


def test_a_lower_claim_and_one_that_is_known_change_nothing() -> None:
    assert at(replace(OWNER, epoch=HIGHER), RUNNING, ClaimHeard("agent3", OWNER.epoch)) == []
    assert at(DISPUTED, AT_REST, ClaimHeard("agent4", HIGHER)) == []


def test_of_a_disputed_task_the_highest_owner_is_remembered() -> None:
    highest = Epoch(HIGHER.n + 9, "agent4")
    assert at(DISPUTED, AT_REST, ClaimHeard("agent4", highest)) == [
        Persist(replace(DISPUTED, peer="agent4", seen=highest))
    ]


@pytest.mark.parametrize("record", [ABSENT, FROZEN, COMMITTED, RELEASED], ids=lambda it: it.phase.name)
def test_only_an_owner_gives_way(record: Record) -> None:
    assert at(record, AT_REST, ClaimHeard("agent3", HIGHER)) == []


def test_it_rests_over_a_crash_a_start_and_a_stop() -> None:
    assert recover(DISPUTED) == [] and rest_of(DISPUTED) == "disputed"
    (decline,) = at(DISPUTED, AT_REST, RunAsked())
    assert isinstance(decline, Decline) and "`pancakes task resolve" in decline.reason
    stopped = at(DISPUTED, AT_REST, Ended(Wanted.STOPPED, b"its end"))
    assert Persist(replace(DISPUTED, snapshot=b"its end")) in stopped


def test_what_could_not_be_written_yet_holds_all_the_same() -> None:
    tried = Volatile(again=DISPUTED)
    assert isinstance(at(OWNER, tried, RunAsked())[0], Decline)
    assert Persist(DISPUTED) in at(OWNER, tried, Ended(Wanted.RUNNING))


def test_adopted_it_runs_under_an_epoch_that_is_higher_than_both() -> None:
    epoch = Epoch(HIGHER.n + 1, ME)
    persist, _, start = at(DISPUTED, AT_REST, AdoptionAsked())
    assert persist == Persist(replace(OWNER, epoch=epoch, seen=epoch, incarnation=0))
    assert start == StartTask(epoch, 0, OWNER.snapshot)


def test_an_adoption_that_cannot_be_written_down_is_not_tried_again() -> None:
    (persist, *_) = at(DISPUTED, AT_REST, AdoptionAsked())
    assert isinstance(persist, Persist)
    assert at(DISPUTED, AT_REST, PersistFailed("full", persist.record)) == []


def test_given_up_it_is_a_tombstone_that_leads_to_the_other_owner() -> None:
    for record in (DISPUTED, replace(OWNER, wanted=Wanted.STOPPED)):
        _, persist, discard = at(record, AT_REST, ForgettingAsked(HIGHER, "agent3"))
        assert persist == Persist(Record(OWNER.task_id, Phase.RELEASED, OWNER.epoch, HIGHER, peer="agent3"))
        assert discard == Discard()


def test_what_runs_is_not_given_up_nor_what_another_does_not_own() -> None:
    for record, owner in ((OWNER, "agent3"), (DISPUTED, "")):
        (decline,) = at(record, RUNNING if record is OWNER else AT_REST, ForgettingAsked(HIGHER, owner))
        assert isinstance(decline, Decline)


def test_an_agent_claims_what_it_owns_in_packets_of_a_bounded_size() -> None:
    assert claims_of([OWNER, FROZEN, COMMITTED, PREPARED, RELEASED, ABSENT]) == [
        OwnerClaim(OWNER.task_id, OWNER.epoch),
        OwnerClaim(FROZEN.task_id, FROZEN.epoch),
    ]
    many = [OwnerClaim(TaskId("a", f"T{number}"), HIGHER) for number in range(IN_ONE_PACKET + 1)]
    assert [len(body.claims) for body in in_packets(many)] == [IN_ONE_PACKET, 1]


def test_of_all_claims_the_highest_counts_and_no_more_are_kept_than_there_is_room_for() -> None:
    claims = Claims()
    low, high = OwnerClaim(OWNER.task_id, Epoch(1, "b")), OwnerClaim(OWNER.task_id, Epoch(2, "b"))
    for peer, claim in (("b", high), ("c", low)):
        claims.heard(peer, claim)
    assert claims.by_peer() == {"b": {OWNER.task_id: high}}
    for number in range(MOST):
        claims.heard("c", OwnerClaim(TaskId("a", f"T{number}"), HIGHER))
    assert len(claims.by_peer()["c"]) == MOST
    assert claims.of(OWNER.task_id) == ("b", high), "an agent that claims much has only its own claims forgotten"
