"""Of a task that is removed, and may begin anew: what the core decides, row by row."""

from __future__ import annotations

import pytest
from migration.handoff_samples import ABSENT, COMMITTED, FROZEN, OWNER, PREPARED, RELEASED, RUNNING
from msgspec.structs import replace

from pancakes.durable.handoff import handle, recover
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    Arrived,
    Born,
    Decline,
    Discard,
    Effect,
    Event,
    ForgettingAsked,
    Persist,
    PersistFailed,
    Received,
    Remember,
    RemovalAsked,
    RunAsked,
    Send,
    StartTask,
)
from pancakes.durable.messages import Activated, Commit, Transfer
from pancakes.durable.ownership import TaskFact, fact_of, newest_fact
from pancakes.durable.record import Epoch, GuardianId, Guards, Phase, Record, Volatile, Wanted, rest_of

ME = OWNER.task_id.birthplace
AT_REST = Volatile()
STOPPED = replace(OWNER, wanted=Wanted.STOPPED)
REMOVED = Record(OWNER.task_id, Phase.RELEASED, OWNER.epoch, max(OWNER.seen, OWNER.epoch), wanted=Wanted.REMOVED)
NEXT = Epoch(REMOVED.seen.n + 1, ME)


def at(record: Record, event: Event, volatile: Volatile = AT_REST) -> list[Effect]:
    return handle(ME, record, volatile, event)


@pytest.mark.parametrize("wanted", [Wanted.STOPPED, Wanted.FAILED])
def test_what_stands_still_is_a_tombstone_on_disk_before_its_place_is_cleared(wanted: Wanted) -> None:
    effects = at(replace(OWNER, wanted=wanted), RemovalAsked())
    assert effects == [Remember(AT_REST), Persist(REMOVED), Discard()]


@pytest.mark.parametrize(
    ("record", "volatile", "why"),
    [
        (OWNER, RUNNING, "was started since"),
        (STOPPED, RUNNING, "was started since"),
        (OWNER, AT_REST, "was started since"),
        (replace(OWNER, wanted=Wanted.DISPUTED, peer="agent3"), AT_REST, "is owned by agent3 too"),
        (ABSENT, AT_REST, "is not here"),
        (FROZEN, AT_REST, "is being handed over"),
        (COMMITTED, AT_REST, "was given to"),
        (PREPARED, AT_REST, "is on its way here"),
        (RELEASED, AT_REST, "moved to"),
        (REMOVED, AT_REST, "was removed"),
    ],
    ids=lambda it: it.phase.name if isinstance(it, Record) else None,
)
def test_nothing_else_is_removed(record: Record, volatile: Volatile, why: str) -> None:
    (decline,) = at(record, RemovalAsked(), volatile)
    assert isinstance(decline, Decline) and why in decline.reason


def test_what_others_guard_is_not_removed_and_what_its_owner_guards_alone_is() -> None:
    me, other = GuardianId(ME, "j1"), GuardianId("agent9", "j9")
    guarded = replace(STOPPED, guards=Guards(OWNER.epoch, 1, ((me, other), (me,))))
    (decline,) = at(guarded, RemovalAsked())
    assert isinstance(decline, Decline) and decline.reason.endswith("is guarded by agent9 still")
    assert Persist(REMOVED) in at(replace(guarded, guards=Guards(OWNER.epoch, 2, ((me,),))), RemovalAsked())


def test_a_removal_that_cannot_be_written_down_is_not_tried_again() -> None:
    assert at(STOPPED, PersistFailed("full", REMOVED)) == []


def test_a_removed_task_stays_away_and_no_late_message_brings_it_back() -> None:
    assert recover(REMOVED) == [] and at(REMOVED, Arrived()) == []
    (decline,) = at(REMOVED, RunAsked())
    assert isinstance(decline, Decline) and decline.reason.endswith("was removed")
    late = REMOVED.seen
    assert at(REMOVED, Received("agent2", Transfer(OWNER.task_id, late, b"old"))) == []
    answer = Send("agent2", Activated(OWNER.task_id, late))
    assert at(REMOVED, Received("agent2", Commit(OWNER.task_id, late))) == [answer]


@pytest.mark.parametrize("event", [Born(b"new"), AdoptionAsked(b"new")], ids=["born", "created"])
def test_it_begins_anew_under_an_epoch_that_is_higher_than_all_that_was_seen_of_it(event: Event) -> None:
    persist, _, start = at(REMOVED, event)
    own = Record(OWNER.task_id, Phase.OWNER, NEXT, NEXT, snapshot=b"new")
    assert (persist, start) == (Persist(own), StartTask(NEXT, 0, b"new"))
    again = at(REMOVED, PersistFailed("full", own))
    assert any(isinstance(effect, Remember) and effect.volatile.again == own for effect in again)


def test_what_its_agent_says_of_it_is_that_it_was_removed() -> None:
    fact = fact_of(ME, REMOVED)
    assert fact == TaskFact(OWNER.task_id, "", REMOVED.seen, removed=True)
    as_register = TaskFact(OWNER.task_id, "agent2", REMOVED.seen)
    assert newest_fact([as_register, fact]) == fact
    later = TaskFact(OWNER.task_id, "agent2", NEXT)
    assert newest_fact([later, fact]) == later
    assert REMOVED.may_begin and not REMOVED.unborn and rest_of(REMOVED) == ""
    assert not RELEASED.may_begin and not RELEASED.removed


def test_what_was_brought_is_dropped_only_for_its_own_hand_off():
    """A person who forgets a lost record does not mean the task that is being handed over just then."""
    (declined,) = at(PREPARED, ForgettingAsked(NEXT))
    assert isinstance(declined, Decline)
    dropped = [it.record for it in at(PREPARED, ForgettingAsked(NEXT, offer=PREPARED.offer)) if isinstance(it, Persist)]
    assert [(it.phase, it.snapshot) for it in dropped] == [(Phase.ABSENT, b"")]
    assert dropped[0].seen >= PREPARED.offer
