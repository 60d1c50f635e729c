"""What a guardian decides, case by case."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.durable.guarding import (
    AnswerAsker,
    GuardRegister,
    GuardsForgotten,
    Lease,
    LeaseOver,
    SetLease,
    WriteRegister,
    handle,
    recover,
)
from pancakes.durable.messages import (
    NO_CHECKPOINT,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    KeepLease,
    LeaseKept,
    Pledge,
    SeizeTask,
    YieldLease,
)
from pancakes.durable.record import (
    MOST_STEP,
    NO_GUARDS,
    Epoch,
    GuardianId,
    Guards,
    TaskId,
    Wanted,
    forgotten_guards,
    newest,
)

TASK = TaskId("north", "Scan")
ME = GuardianId("east", "j1")
OTHERS = (GuardianId("north", "j0"), GuardianId("south", "j2"))
OLD, NEW, NEWEST = Epoch(1, "north"), Epoch(2, "south"), Epoch(3, "west")
GUARDS = Guards(OLD, 0, ((ME, *OTHERS),))
BODY = CheckpointBody(b"state", Wanted.RUNNING)
KEPT = CheckpointId(OLD, 4)
HELD = GuardRegister(TASK, "scan", OLD, KEPT, BODY, GUARDS, 2.0)
KEEP = KeepLease(TASK, "scan", OLD, 7, 2.0, KEPT, GUARDS)
SEIZE = SeizeTask(TASK, "scan", NEW, GUARDS)
RUNS, OVER = Lease(OLD, 5), Lease(None, 5)


def answer(*effects):
    (said,) = [effect.message for effect in effects if isinstance(effect, AnswerAsker)]
    return said


def test_the_first_keep_is_written_down_before_it_is_granted():
    first = replace(KEEP, body=BODY)
    kept = LeaseKept(TASK, OLD, ME, 7, 4, 0)
    assert handle(ME, GuardRegister(TASK), Lease(), first) == [
        WriteRegister(HELD),
        SetLease(Lease(OLD, 1, 7), 2.0),
        AnswerAsker(kept),
    ]


def test_a_keep_without_news_costs_no_write():
    assert handle(ME, HELD, RUNS, KEEP) == [
        SetLease(Lease(OLD, 6, 7), 2.0),
        AnswerAsker(LeaseKept(TASK, OLD, ME, 7, 4, 0)),
    ]


def test_a_checkpoint_whose_body_is_lacking_is_not_kept_but_the_lease_is_granted():
    later = replace(KEEP, checkpoint=CheckpointId(OLD, 5))
    assert answer(*handle(ME, HELD, RUNS, later)).no == 4
    assert answer(*handle(ME, HELD, RUNS, replace(later, body=BODY))).no == 5


def test_an_older_checkpoint_never_takes_the_place_of_a_newer_one():
    late = replace(KEEP, checkpoint=CheckpointId(OLD, 3), body=CheckpointBody(b"older"))
    assert not any(isinstance(effect, WriteRegister) for effect in handle(ME, HELD, RUNS, late))


def test_a_passed_owner_is_denied_and_told_the_epoch():
    promised = replace(HELD, promised=NEW)
    (denied,) = handle(ME, promised, OVER, KEEP)
    assert isinstance(denied, AnswerAsker) and isinstance(denied.message, DenyLease)
    assert denied.message.promised == NEW


def test_an_agent_that_is_no_guardian_keeps_nothing():
    others = Guards(OLD, 1, (OTHERS,))
    assert isinstance(answer(*handle(ME, HELD, RUNS, replace(KEEP, guards=others))), DenyLease)


def test_it_pledges_itself_once_its_lease_is_over_and_the_promise_is_on_disk_first():
    assert handle(ME, HELD, OVER, SEIZE) == [
        WriteRegister(replace(HELD, promised=NEW)),
        SetLease(Lease(None, 5), 0.0),
        AnswerAsker(Pledge(TASK, NEW, ME, KEPT, GUARDS, BODY)),
    ]


def test_guardian_pledges_itself_to_none_while_a_lease_runs():
    assert isinstance(answer(*handle(ME, HELD, RUNS, SEIZE)), DenyLease)


def test_guardian_takes_no_keep_of_another_epoch_while_a_lease_runs():
    """A liar's would shorten the owner's lease, or end its memory."""
    for keep in (replace(KEEP, epoch=NEW, lease_s=0.5), replace(KEEP, epoch=NEW, body=None)):
        denied = answer(*handle(ME, HELD, RUNS, keep))
        assert isinstance(denied, DenyLease) and denied.reason == f"the lease of the epoch {OLD} runs"
    assert isinstance(answer(*handle(ME, HELD, OVER, replace(KEEP, epoch=NEW))), LeaseKept)
    pledged = replace(HELD, promised=NEW)
    assert isinstance(answer(*handle(ME, pledged, OVER, replace(KEEP, epoch=NEW))), LeaseKept)


def test_only_the_owner_has_its_memory_forgotten_while_its_lease_runs():
    removed = replace(KEEP, epoch=NEW, guards=forgotten_guards(NEW))
    assert handle(ME, HELD, RUNS, removed) == []
    assert handle(ME, HELD, RUNS, replace(KEEP, guards=forgotten_guards(NEW))) == [], "it is of another epoch"
    (write,) = handle(ME, HELD, RUNS, replace(KEEP, guards=forgotten_guards(OLD)))
    assert isinstance(write, WriteRegister) and write.register.body is None


def test_a_pledge_that_was_lost_is_said_again_and_to_no_other_agent():
    promised = replace(HELD, promised=NEW)
    assert handle(ME, promised, OVER, SEIZE) == [AnswerAsker(Pledge(TASK, NEW, ME, KEPT, GUARDS, BODY))]
    lower = replace(SEIZE, epoch=Epoch(2, "east"))
    assert isinstance(answer(*handle(ME, promised, OVER, lower)), DenyLease)


def test_once_the_new_owner_was_heard_of_its_epoch_is_pledged_to_no_more():
    owned = replace(HELD, promised=NEW, guards=replace(GUARDS, epoch=NEW))
    assert isinstance(answer(*handle(ME, owned, OVER, SEIZE)), DenyLease)


def test_one_that_is_to_join_pledges_itself_although_it_knows_nothing():
    pledge = answer(*handle(ME, GuardRegister(TASK), Lease(), SEIZE))
    assert pledge == Pledge(TASK, NEW, ME, NO_CHECKPOINT, NO_GUARDS, None)
    stranger = replace(SEIZE, guards=Guards(OLD, 0, (OTHERS,)))
    assert isinstance(answer(*handle(ME, GuardRegister(TASK), Lease(), stranger)), DenyLease)


def test_epochs_rise_in_bounded_steps():
    far = Epoch(OLD.n + MOST_STEP + 1, "west")
    for event in (replace(SEIZE, epoch=far), replace(KEEP, epoch=far)):
        denied = answer(*handle(ME, HELD, OVER, event))
        assert isinstance(denied, DenyLease) and "out of the order" in denied.reason


def test_the_end_of_an_older_lease_does_not_end_a_newer_one():
    assert handle(ME, HELD, RUNS, LeaseOver(4)) == []
    assert handle(ME, HELD, RUNS, LeaseOver(5)) == [SetLease(OVER, 0.0)]


def test_a_goodbye_ends_the_lease_that_it_is_about_and_no_later_one():
    runs = Lease(OLD, 5, beat=7, boot=2)
    assert handle(ME, HELD, runs, YieldLease(TASK, OLD, 7, 2)) == [SetLease(replace(runs, epoch=None), 0.0)]
    assert handle(ME, HELD, runs, YieldLease(TASK, OLD, 6, 2)) == [], "the owner has asked again since"
    assert handle(ME, HELD, runs, YieldLease(TASK, OLD, 7, 1)) == [], (
        "what it granted in its former life it has forgotten"
    )
    assert handle(ME, HELD, runs, YieldLease(TASK, NEW, 7, 2)) == []


def test_a_keep_that_comes_late_makes_a_lease_no_older():
    runs = Lease(OLD, 5, beat=9, boot=2)
    granted = [effect.lease for effect in handle(ME, HELD, runs, KEEP) if isinstance(effect, SetLease)]
    assert granted == [Lease(OLD, 6, beat=9, boot=2)]


def test_after_a_restart_it_waits_for_a_whole_lease():
    assert recover(HELD) == [SetLease(Lease(OLD, 1), 2.0)]
    assert recover(GuardRegister(TASK, promised=NEW)) == [], "it never gave one"


def test_a_quorum_is_more_than_half_of_each_set():
    joint = Guards(
        OLD, 1, ((ME, *OTHERS), (GuardianId("up", "j3"), GuardianId("down", "j4"), GuardianId("left", "j5")))
    )
    assert not joint.has_quorum([ME, *OTHERS])
    assert joint.has_quorum([ME, OTHERS[0], GuardianId("up", "j3"), GuardianId("left", "j5")])
    assert not NO_GUARDS.has_quorum([ME])
    assert not GUARDS.has_quorum([ME, replace_journal(OTHERS[0])]), "its disk was lost"
    assert newest(joint, GUARDS) is joint and newest(joint, replace(GUARDS, epoch=NEW)).epoch == NEW


def replace_journal(member):
    return GuardianId(member.agent, "another")


FORGOTTEN = forgotten_guards(OLD)
FORGET = replace(KEEP, checkpoint=NO_CHECKPOINT, guards=FORGOTTEN)
EMPTY = replace(HELD, checkpoint=NO_CHECKPOINT, body=None, guards=FORGOTTEN)


def test_of_a_task_that_was_removed_it_keeps_the_epoch_alone():
    assert handle(ME, HELD, RUNS, FORGET) == [WriteRegister(EMPTY)]
    assert handle(ME, HELD, OVER, GuardsForgotten(FORGOTTEN)) == [WriteRegister(EMPTY)]
    assert handle(ME, EMPTY, OVER, FORGET) == []
    assert handle(ME, GuardRegister(TASK), Lease(), FORGET) == []
    assert recover(EMPTY) == []


def test_what_follows_a_later_owner_is_not_forgotten_at_the_word_of_an_earlier_one():
    for later in (replace(HELD, promised=NEW), replace(HELD, promised=NEW, guards=replace(GUARDS, epoch=NEW))):
        assert handle(ME, later, OVER, FORGET) == []


def test_no_agent_takes_a_task_that_was_removed_nor_keeps_it():
    assert answer(*handle(ME, EMPTY, OVER, SEIZE)) == DenyLease(TASK, NEW, ME, OLD, "it was removed")
    assert answer(*handle(ME, EMPTY, OVER, KEEP)) == DenyLease(TASK, OLD, ME, OLD, "it was removed")


def test_one_that_was_created_anew_is_guarded_again():
    guards = replace(GUARDS, epoch=NEW)
    anew = KeepLease(TASK, "scan", NEW, 1, 2.0, CheckpointId(NEW, 0), guards, BODY)
    write, *_ = handle(ME, EMPTY, OVER, anew)
    assert write == WriteRegister(replace(HELD, promised=NEW, checkpoint=CheckpointId(NEW, 0), guards=guards))
    taken = replace(SEIZE, epoch=NEWEST, guards=guards)
    assert isinstance(answer(*handle(ME, EMPTY, OVER, taken)), Pledge)
