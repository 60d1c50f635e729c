"""What an owner makes of what its guardians say, and an agent that is to take a task."""

import pytest
from msgspec.structs import replace

from pancakes.durable.guarding import (
    Seizing,
    Tenure,
    answered,
    asked_again,
    begun,
    conclusion,
    keep_lease,
    kept_packets,
    may_ask,
    told,
    yield_lease,
)
from pancakes.durable.handoff_events import ClaimHeard, GuardsChosen, PacketId
from pancakes.durable.messages import (
    NO_CHECKPOINT,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    LeaseKept,
    Pledge,
    YieldLease,
)
from pancakes.durable.record import NO_EPOCH, Epoch, GuardianId, Guards, Phase, Record, TaskId, Wanted

TASK = TaskId("a", "Scan")
A, B, C, D = (GuardianId(name, "j") for name in "abcd")
E1, E2, E3 = Epoch(1, "a"), Epoch(2, "b"), Epoch(3, "c")
THREE = Guards(E1, 2, ((A, B, C),))
JOINT = Guards(E1, 1, ((A,), (A, B, C)))
OWNER = Record(TASK, Phase.OWNER, E1, E1, snapshot=b"s", guards=THREE, no=4)


def kept(guardian, beat=1, no=4, version=2, epoch=E1):
    return LeaseKept(TASK, epoch, guardian, beat, no, version)


def deny(guardian, promised, epoch=E1):
    return DenyLease(TASK, epoch, guardian, promised, "why")


def after(*answers, record=OWNER, beats=3):
    tenure = Tenure()
    for _ in range(beats):
        tenure = asked_again(tenure, record)
    for answer in answers:
        tenure = answered(tenure, record, answer)
    return tenure


class TestAPermit:
    def test_it_needs_a_quorum_for_the_same_beat(self):
        assert after(kept(A)).granted_beat(THREE) == 0
        assert after(kept(A), kept(B)).granted_beat(THREE) == 1
        assert after(kept(A, 3), kept(B, 1)).granted_beat(THREE) == 1
        assert after(kept(A, 3), kept(B, 2), kept(C, 1)).granted_beat(THREE) == 2

    def test_while_guardians_are_replaced_it_needs_one_of_each_set(self):
        record = Record(TASK, Phase.OWNER, E1, E1, guards=JOINT)
        both = [kept(B, version=1), kept(C, version=1)]
        assert after(*both, record=record).granted_beat(JOINT) == 0
        assert after(*both, kept(A, version=1), record=record).granted_beat(JOINT) == 1

    def test_a_guardian_that_does_not_know_the_guards_does_not_count(self):
        assert after(kept(A), kept(B, version=1)).granted_beat(THREE) == 0

    def test_what_a_stranger_says_and_what_is_late_or_of_another_epoch_counts_for_nothing(self):
        before = after(kept(A))
        for answer in (kept(D), kept(B, epoch=E2), kept(B, beat=9), kept(A, beat=0)):
            assert answered(before, OWNER, answer) == before

    def test_a_new_epoch_begins_without_answers_and_its_beats_go_on(self):
        tenure = asked_again(after(kept(A), kept(B)), Record(TASK, Phase.OWNER, E2, E2, guards=THREE))
        assert tenure.answers == () and tenure.beat == 4

    def test_an_owner_whose_disk_is_an_old_copy_is_told(self):
        assert may_ask(after(kept(A)), OWNER)
        old = after(kept(B, no=5))
        assert not may_ask(old, OWNER)
        later = replace(OWNER, no=6)
        assert not may_ask(answered(old, later, kept(A)), later), "what it wrote since is no newer than theirs"

    def test_one_that_owns_it_anew_asks_again(self):
        anew = replace(OWNER, epoch=E2, seen=E2)
        assert may_ask(after(kept(B, no=5)), anew)
        assert not asked_again(after(kept(B, no=5)), anew).behind


class TestItsBeats:
    def test_those_of_a_later_life_are_higher_although_the_clock_begins_anew(self):
        first = begun(1, 400 * 86_400.0)
        assert asked_again(first, OWNER).beat < begun(2, 0.0).beat < begun(2, 0.5).beat

    def test_an_answer_to_a_former_life_says_nothing_of_a_lease(self):
        former = asked_again(begun(3, 9e6), OWNER)
        tenure = asked_again(begun(4, 0.0), OWNER)
        for guardian in (A, B, C):
            tenure = answered(tenure, OWNER, kept(guardian, former.beat))
        assert tenure.granted_beat(THREE) < tenure.beat

    def test_a_goodbye_names_the_last_one_and_the_life_of_the_guardian_that_was_heard(self):
        tenure = after(LeaseKept(TASK, E1, B, 2, 4, 2, boot=7))
        assert yield_lease(tenure, OWNER, B) == YieldLease(TASK, E1, 3, 7)
        assert yield_lease(tenure, OWNER, C).boot == -1, "it has granted nothing"


class TestACheckpoint:
    def test_it_is_safe_once_a_quorum_has_it(self):
        assert after(kept(A, no=4)).replicated_no(THREE) == -1
        assert after(kept(A, no=4), kept(B, no=3)).replicated_no(THREE) == 3
        assert after(kept(A, no=4), kept(B, no=3), kept(C, no=4)).replicated_no(THREE) == 4

    def test_an_older_answer_takes_nothing_back(self):
        assert after(kept(A, 2, no=4), kept(A, 2, no=-1)).of(A).no == 4

    def test_a_guardian_that_has_begun_anew_has_what_it_says_and_no_more(self):
        former, later = replace(kept(A, 2, no=4), boot=6), replace(kept(A, 2, no=2, version=1), boot=7)
        tenure = after(former, kept(B, 2, no=4), later)
        assert (tenure.of(A).no, tenure.of(A).version) == (2, 1), "its disk is an old copy"
        assert tenure.replicated_no(THREE) == 2 and tenure.granted_beat(THREE) == 0
        assert after(later, former).of(A).no == 2, "what it said in its former life comes late"

    def test_an_owner_that_has_told_of_a_later_one_than_its_disk_has_is_behind(self):
        told = replace(kept(B, no=3), told=5)
        assert after(told).behind and not may_ask(after(told), OWNER)
        assert not after(replace(told, told=4)).behind


def test_guards_may_change_once_a_quorum_of_both_sets_has_them_and_the_newest_checkpoint():
    record = Record(TASK, Phase.OWNER, E1, E1, guards=JOINT)
    new = [kept(A, version=1), kept(B, version=1)]
    assert after(*new, record=record).have(JOINT, 4)
    assert not after(*new, record=record).have(JOINT, 5)
    assert not after(kept(B, version=1), kept(C, version=1), record=record).have(JOINT, 4)
    assert not after(kept(A, version=1), kept(B, version=0), record=record).have(JOINT, 4)


class TestAnAcknowledgement:
    first, second = PacketId("s", 1), PacketId("s", 2)
    owed = ((CheckpointId(E1, 4), first), (CheckpointId(E1, 5), second))

    def test_it_waits_for_a_quorum(self):
        assert kept_packets(after(kept(A, no=5)), OWNER, self.owed) == ([], list(self.owed))
        assert kept_packets(after(kept(A, no=5), kept(B)), OWNER, self.owed) == ([self.first], [self.owed[1]])

    def test_what_was_owed_under_another_epoch_is_not_given(self):
        anew = replace(OWNER, epoch=E2, seen=E2)
        tenure = asked_again(after(kept(A)), anew)
        for guardian in (A, B):
            tenure = answered(tenure, anew, kept(guardian, tenure.beat, no=9, epoch=E2))
        assert kept_packets(tenure, anew, self.owed) == ([], [])


class TestWhatFollows:
    def test_an_owner_that_is_outvoted_gives_the_task_up_unless_it_acts_or_asks_for_pledges(self):
        outvoted = after(deny(B, E2), deny(C, E3))
        assert conclusion(outvoted, OWNER, acts=False, seizes=False) == ClaimHeard("c", E3)
        assert conclusion(outvoted, OWNER, acts=True, seizes=False) is None
        assert conclusion(outvoted, OWNER, acts=False, seizes=True) is None

    def test_an_epoch_of_its_own_has_no_other_owner(self):
        own = Epoch(5, "a")
        assert conclusion(after(deny(B, own), deny(C, own)), OWNER, acts=False, seizes=False) == ClaimHeard("", own)

    def test_new_guardians_decide_alone_once_both_sets_know_of_them(self):
        record = replace(OWNER, guards=JOINT)
        known = after(kept(A, version=1), kept(B, version=1), record=record)
        assert conclusion(known, record, acts=True, seizes=False) == GuardsChosen(JOINT.sets[1:])
        assert conclusion(after(kept(A, version=1), record=record), record, acts=True, seizes=False) is None


class TestOutvoted:
    def test_one_that_is_silent_for_long_follows_it_no_more(self):
        waits = after(deny(A, E2), kept(C), beats=9)
        assert waits.outvoted_by(THREE) == NO_EPOCH
        assert asked_again(waits, OWNER).outvoted_by(THREE) == E2, "B has said nothing for nine askings"

    def test_one_that_follows_another_is_not_enough(self):
        assert after(deny(B, E2)).outvoted_by(THREE) == NO_EPOCH

    def test_it_is_once_the_others_are_no_quorum(self):
        assert after(deny(B, E2), deny(C, E3)).outvoted_by(THREE) == E3

    def test_a_guardian_that_denies_for_another_reason_follows_no_other(self):
        assert after(deny(B, E1), deny(C, NO_EPOCH)).outvoted_by(THREE) == NO_EPOCH

    def test_one_that_grants_again_follows_the_owner_again(self):
        assert after(deny(B, E2), deny(C, E2), kept(B)).outvoted_by(THREE) == NO_EPOCH


def test_a_lease_is_asked_for_with_what_is_on_disk():
    keep = keep_lease(after(), OWNER, "scan", 2.0, with_body=True)
    assert (keep.epoch, keep.beat, keep.checkpoint, keep.guards) == (E1, 3, CheckpointId(E1, 4), THREE)
    assert keep.body == CheckpointBody(b"s", Wanted.RUNNING)
    assert keep_lease(after(), OWNER, "scan", 2.0, with_body=False).body is None


def pledge(guardian, no=4, body=b"s", epoch=E2, guards=THREE, of=E1):
    held = CheckpointBody(body) if body else None
    return Pledge(TASK, epoch, guardian, CheckpointId(of, no) if body else NO_CHECKPOINT, guards, held)


SEIZING = Seizing(TASK, "scan", E2, THREE, NO_CHECKPOINT, None)


def seizing(*answers, start=SEIZING):
    for answer in answers:
        start = told(start, answer)
    return start


class TestTaking:
    def test_it_needs_a_quorum(self):
        assert seizing(pledge(A)).result() is None
        result = seizing(pledge(A), pledge(B)).result()
        assert (result.epoch, result.snapshot, result.source) == (E2, b"s", "")

    def test_a_guardian_counts_once(self):
        assert seizing(pledge(A), pledge(A)).result() is None

    def test_the_newest_checkpoint_counts(self):
        assert seizing(pledge(A, 5, b"new"), pledge(B, 4, b"old")).result().snapshot == b"new"
        assert seizing(pledge(A, 9, b"old"), pledge(B, 0, b"new", of=E2)).result().snapshot == b"new"

    def test_what_was_given_counts_where_it_is_the_newest(self):
        given = Seizing(TASK, "scan", E2, THREE, CheckpointId(E1, 6), CheckpointBody(b"given"), "a", E1)
        result = seizing(pledge(B, 5, b"old"), pledge(C, 5, b"old"), start=given).result()
        assert (result.snapshot, result.source, result.offer) == (b"given", "a", E1)

    def test_the_newest_guards_that_any_of_them_knows_decide(self):
        newer = Guards(E1, 3, ((B, C, D),))
        so_far = seizing(pledge(A), pledge(B, guards=newer))
        assert so_far.result() is None and so_far.unasked() == [C, D]
        assert seizing(pledge(D, guards=newer), start=so_far).result().guards == newer

    def test_without_a_checkpoint_there_is_nothing_to_run(self):
        assert seizing(pledge(A, body=b""), pledge(B, body=b"")).result() is None

    @pytest.mark.parametrize("answer", [pledge(B, epoch=E3), kept(B, epoch=E2), deny(B, E3, epoch=E3)])
    def test_what_answers_something_else_changes_nothing(self, answer):
        assert told(SEIZING, answer) == SEIZING

    def test_it_knows_what_epoch_it_must_exceed(self):
        assert seizing(deny(B, E3, epoch=E2), deny(C, E1, epoch=E2)).promised() == E3
