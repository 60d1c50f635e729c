"""What the hand-off's core decides for a guarded task: its guardians decide who may run it."""

import msgspec
import pytest
from msgspec.structs import replace

from pancakes.durable.handoff import handle, recover
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    AttemptFailed,
    Born,
    Checkpoint,
    ClaimHeard,
    Discard,
    GuardsChosen,
    HandedOver,
    PermitGiven,
    Persist,
    Received,
    Remember,
    RunAsked,
    Seize,
    Seized,
    Send,
    StartTask,
)
from pancakes.durable.messages import Activated, Commit
from pancakes.durable.record import (
    MORE_THAN_MOVES,
    NO_EPOCH,
    NO_GUARDS,
    Epoch,
    GuardianId,
    GuardianSet,
    Guards,
    Phase,
    Record,
    TaskId,
    Volatile,
    Wanted,
)

TASK = TaskId("a", "Scan")
A, B, C = (GuardianId(name, "j") for name in "abc")
E1, E2, E3 = Epoch(1, "a"), Epoch(2, "b"), Epoch(3, "a")
GUARDS = Guards(E1, 2, ((A, B, C),))
OWNER = Record(TASK, Phase.OWNER, E1, E1, snapshot=b"s", guards=GUARDS, no=4)
RUNS = Volatile(running=True)
IDLE = Volatile()
COMMITTED = replace(OWNER, phase=Phase.COMMITTED, offer=E2, seen=E2, peer="b")
PREPARED = Record(TASK, Phase.PREPARED, seen=E1, offer=E1, peer="b", snapshot=b"p")
SEIZED = Seized(E3, Guards(E2, 5, ((B, C),)), b"new", Wanted.RUNNING, "", NO_EPOCH)


def kinds(effects):
    return [type(effect) for effect in effects]


def persisted(effects):
    return [effect.record for effect in effects if isinstance(effect, Persist)]


def test_it_is_born_with_its_agent_as_its_first_guardian_and_starts_with_a_permit():
    effects = handle("a", Record(TASK), IDLE, Born(b"s", A), permit=False)
    (born,) = persisted(effects)
    assert (born.guards, born.no) == (Guards(Epoch(0, "a"), 0, ((A,),)), 0)
    assert effects[-1] == Remember(IDLE) and StartTask not in kinds(effects)
    assert kinds(handle("a", born, IDLE, PermitGiven())) == [Remember, StartTask]


@pytest.mark.parametrize("record", [OWNER, replace(OWNER, phase=Phase.FROZEN, offer=E2, peer="b")])
def test_after_a_restart_it_waits_for_its_guardians(record):
    assert StartTask not in kinds(recover(record))
    assert StartTask in kinds(recover(replace(record, guards=NO_GUARDS)))


def test_a_restart_by_its_service_waits_too():
    assert StartTask not in kinds(handle("a", OWNER, RUNS, RunAsked(again=True), permit=False))
    assert StartTask in kinds(handle("a", OWNER, RUNS, RunAsked(again=True), permit=True))


@pytest.mark.parametrize(
    ("record", "volatile"),
    [
        (OWNER, RUNS),
        (replace(OWNER, wanted=Wanted.STOPPED), IDLE),
        (replace(OWNER, guards=NO_GUARDS), IDLE),
        (COMMITTED, IDLE),
        (OWNER, Volatile(again=OWNER)),
    ],
)
def test_a_permit_starts_nothing_else(record, volatile):
    assert handle("a", record, volatile, PermitGiven()) == []


def test_checkpoints_are_numbered_where_they_differ():
    first = Checkpoint(E1, 0, b"t")
    assert persisted(handle("a", OWNER, RUNS, first))[0].no == 5
    assert persisted(handle("a", OWNER, RUNS, replace(first, snapshot=b"s")))[0].no == 4
    unguarded = replace(OWNER, guards=NO_GUARDS, no=0)
    assert persisted(handle("a", unguarded, RUNS, first))[0].no == 0


def test_guards_are_counted():
    (record,) = persisted(handle("a", OWNER, RUNS, GuardsChosen(((A, B, C), (A, C)))))
    assert (record.guards.version, record.guards.epoch, record.no) == (3, E1, 4)
    assert handle("a", OWNER, RUNS, GuardsChosen(GUARDS.sets)) == []
    assert handle("a", COMMITTED, IDLE, GuardsChosen(((A,),))) == []


def test_where_its_guardians_are_gone_for_good_it_is_owned_anew_as_it_stands():
    alone = GuardsChosen(((A,),), MORE_THAN_MOVES, seen=7)
    (record,) = persisted(handle("a", OWNER, RUNS, alone, permit=False))
    assert record.epoch == record.seen == Epoch(MORE_THAN_MOVES + 7, "a")
    assert record.guards == Guards(record.epoch, 0, ((A,),)) and record.snapshot == OWNER.snapshot
    again = persisted(handle("a", record, RUNS, alone, permit=False))
    assert again[0].epoch.n == record.epoch.n + MORE_THAN_MOVES
    assert handle("a", COMMITTED, IDLE, alone) == []


def test_a_task_that_came_by_an_epoch_of_another_is_guarded_under_one_of_its_own():
    came = replace(OWNER, epoch=E2, seen=E2, guards=NO_GUARDS, no=0)
    (record,) = persisted(handle("a", came, RUNS, GuardsChosen(((A,),))))
    assert record.epoch == record.seen == record.guards.epoch == E3


class TestSeized:
    @pytest.mark.parametrize("record", [Record(TASK), replace(OWNER, seen=E2), PREPARED, COMMITTED])
    def test_it_owns_the_task_and_waits_for_a_permit(self, record):
        effects = handle("a", record, IDLE, SEIZED, permit=False)
        (own,) = persisted(effects)
        assert (own.phase, own.epoch, own.seen, own.snapshot, own.no) == (Phase.OWNER, E3, E3, b"new", 0)
        assert own.guards == Guards(E3, 0, ((B, C),))
        assert StartTask not in kinds(effects) and effects[-1] == Remember(IDLE)

    def test_what_was_to_be_given_away_is_not(self):
        assert AttemptFailed in kinds(handle("a", COMMITTED, IDLE, SEIZED))

    def test_one_that_was_stopped_stays_so(self):
        effects = handle("a", OWNER, IDLE, replace(SEIZED, wanted=Wanted.STOPPED))
        assert kinds(effects) == [Persist] and persisted(effects)[0].wanted is Wanted.STOPPED

    @pytest.mark.parametrize(
        ("record", "volatile", "event"),
        [
            (replace(OWNER, seen=E3), IDLE, SEIZED),
            (OWNER, IDLE, replace(SEIZED, epoch=Epoch(9, "b"))),
            (OWNER, RUNS, SEIZED),
            (replace(OWNER, phase=Phase.FROZEN), IDLE, SEIZED),
            (OWNER, IDLE, replace(SEIZED, source="b", offer=E1)),
            (PREPARED, IDLE, replace(SEIZED, source="c", offer=E1)),
            (PREPARED, IDLE, replace(SEIZED, source="b", offer=E2)),
        ],
    )
    def test_else_it_does_not(self, record, volatile, event):
        assert handle("a", record, volatile, event) == []

    def test_one_that_was_given_says_so_and_goes_on_where_it_stood(self):
        effects = handle("a", PREPARED, IDLE, replace(SEIZED, source="b", offer=E1), permit=False)
        assert effects[-1] == Send("b", Activated(TASK, E1))
        (remembered,) = [effect.volatile for effect in effects if isinstance(effect, Remember)]
        (own,) = persisted(effects)
        start = handle("a", own, remembered, PermitGiven())[-1]
        assert remembered.fresh and isinstance(start, StartTask) and start.fresh


def test_a_commit_of_a_guarded_task_asks_the_guardians_and_writes_nothing():
    commit = Commit(TASK, E1, GUARDS, Epoch(0, "b"), 7)
    assert handle("a", PREPARED, IDLE, Received("b", commit)) == [Seize("b", commit)]
    assert handle("a", PREPARED, IDLE, Received("c", commit)) == []


class TestAClaim:
    later, same = ClaimHeard("b", E2), ClaimHeard("b", E1)

    def test_it_ends_the_copy_here_where_there_is_no_permit(self):
        effects = handle("a", OWNER, RUNS, self.later, permit=False)
        assert kinds(effects) == [Remember, Persist, Discard]
        (record,) = persisted(effects)
        assert (record.phase, record.peer, record.seen, record.snapshot) == (Phase.RELEASED, "b", E2, b"")

    def test_it_is_nothing_where_the_guardians_stand_by_this_owner(self):
        assert handle("a", OWNER, RUNS, self.later, permit=True) == []
        assert handle("a", OWNER, IDLE, ClaimHeard("b", NO_EPOCH), permit=False) == []

    def test_at_equal_epochs_both_stand_still(self):
        (record,) = persisted(handle("a", OWNER, RUNS, self.same, permit=True))
        assert record.wanted is Wanted.DISPUTED

    @pytest.mark.parametrize("permit", [True, False])
    def test_where_a_person_has_decided_that_this_owner_is_lost_it_stands_still(self, permit):
        by_person = ClaimHeard("b", Epoch(MORE_THAN_MOVES, "b"))
        (record,) = persisted(handle("a", OWNER, RUNS, by_person, permit=permit))
        assert (record.wanted, record.phase, record.peer) == (Wanted.DISPUTED, Phase.OWNER, "b")
        assert record.snapshot == OWNER.snapshot

    def test_an_epoch_of_ones_own_is_no_dispute(self):
        assert handle("a", OWNER, IDLE, ClaimHeard("", E1), permit=False) == []

    def test_it_ends_a_hand_off_in_doubt(self):
        effects = handle("a", COMMITTED, IDLE, ClaimHeard("c", E3))
        assert kinds(effects) == [Persist, HandedOver] and persisted(effects)[0].peer == "c"
        assert handle("a", COMMITTED, IDLE, ClaimHeard("c", E2)) == []

    def test_it_ends_an_offer(self):
        offered = replace(PREPARED, offer=E2, seen=E2)
        effects = handle("a", offered, IDLE, ClaimHeard("c", E3))
        assert kinds(effects) == [Persist, Discard]
        (record,) = persisted(effects)
        assert record == Record(TASK, epoch=offered.epoch, seen=E3, peer="c")
        assert handle("a", offered, IDLE, ClaimHeard("c", E2)) == []
        late = Received(PREPARED.peer, Commit(TASK, E2))
        assert handle("a", record, IDLE, late) == [Send(PREPARED.peer, Activated(TASK, E2))]


def test_an_adoption_has_the_task_guarded_by_this_agent_alone():
    (record,) = persisted(handle("a", COMMITTED, IDLE, AdoptionAsked(guardian=A)))
    assert record.guards.sets == ((A,),)


def test_an_adoption_is_above_every_epoch_under_which_others_may_have_taken_the_task_over():
    (adopted,) = persisted(handle("a", COMMITTED, IDLE, AdoptionAsked(guardian=A)))
    taken_over = Epoch(E2.n + 1, "b")  # what a destination mints, of which its giver hears nothing
    assert adopted.epoch == adopted.seen and adopted.epoch.n > taken_over.n + 1_000


def test_a_set_has_five_guardians_at_most() -> None:
    named = [[name, "journal"] for name in "abcdef"]
    assert len(msgspec.convert(named[:5], GuardianSet)) == 5
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(named, GuardianSet)
