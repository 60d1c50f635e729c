"""The streams of one agent: one for each task that sends, which takes it along when it moves."""

import gc

import pytest

from pancakes.durable.courier import Outbox
from pancakes.durable.delivery import ForwardTo, Outgoing, OutgoingLetter, Receipt
from pancakes.durable.record import TaskId

SINK = TaskId("a", "Sink")
ME = "s/Source"


@pytest.fixture
def box():
    return Outbox("s/uuid.1", "s")


def post(box, *packets, sender=ME, now_s=0.0):
    box.take_unsent()
    for packet in packets:
        box.post(sender, SINK, packet, "a", now_s)
    return letters(box.take_unsent())


def letters(to_send):
    return [sent.letter for sent in to_send if isinstance(sent, OutgoingLetter)]


def acknowledge(box, letter, seq, epoch_n=0):
    """The agent a says that letters up to a number have had their effect."""
    box.acknowledged(Receipt("a/Sink", letter.stream, seq, epoch_n), "a", 0.0)


def due(box, now_s):
    """What is to be sent by then."""
    box.look(now_s)
    return letters(box.take_unsent())


def numbered(letters):
    """What people see of them: the name without what tells it to a task's agent."""
    return [(letter.stream.partition("#")[0], letter.seq, letter.sender) for letter in letters]


def test_each_task_that_sends_has_a_stream_and_all_others_have_one():
    box = Outbox("s/uuid.1", "s")
    assert numbered(post(box, b"1", b"2")) == [("s/uuid.1/1", 1, "s"), ("s/uuid.1/1", 2, "s")]
    assert numbered(post(box, b"1", sender="s/Other")) == [("s/uuid.1/2", 1, "s")]
    assert numbered(post(box, b"1", sender="")) == [("s/uuid.1", 1, "s")]
    assert box.waiting() == {"a/Sink": 4}


def test_a_new_stream_begins_where_the_others_know_the_task_to_be(box):
    post(box, b"1")
    box.forwarded(ForwardTo("a/Sink", "b", 3), "a", 0.0)
    box.take_unsent()
    box.post("s/Other", SINK, b"2", "a", 0.0)
    assert [getattr(sent, "peer", "") for sent in box.take_unsent()] == ["b"]


def test_a_task_goes_on_in_its_stream_on_its_new_host(box):
    acknowledge(box, post(box, b"1", b"2", b"3")[0], 1)
    posted = box.leave(ME)
    there = Outbox("t/uuid.1", "t")
    there.arrive(ME, posted, fresh=True, now_s=0.0)
    # What was not acknowledged is sent again from there, and wants its acknowledgement there.
    again = due(there, 0.0)
    assert numbered(again) == [("s/uuid.1/1", 2, "t"), ("s/uuid.1/1", 3, "t")]
    assert [letter.first for letter in again] == [2, 2]
    assert numbered(post(there, b"4")) == [("s/uuid.1/1", 4, "t")]
    box.gone(ME)
    assert box.waiting() == {} and due(box, 100.0) == []


def test_numbers_go_on_where_all_was_acknowledged(box):
    acknowledge(box, post(box, b"1")[0], 1)
    there = Outbox("t/uuid.1", "t")
    there.arrive(ME, box.leave(ME), fresh=True, now_s=0.0)
    assert numbered(post(there, b"2")) == [("s/uuid.1/1", 2, "t")]


def test_while_it_stands_still_nobody_adds_to_its_stream(box):
    """What a thread of the task's own sends goes with what is sent by those who do not move."""
    post(box, b"1")
    box.leave(ME)
    assert numbered(post(box, b"2")) == [("s/uuid.1", 1, "s")]
    box.gone(ME)
    assert box.waiting() == {"a/Sink": 1}


def test_what_it_sends_in_its_end_has_no_stream_of_its_own_until_it_comes_back(box):
    posted = box.leave(ME)
    box.gone(ME, ends=True)
    assert numbered(post(box, b"1")) == [("s/uuid.1", 1, "s")]
    box.ended(ME)
    box.arrive(ME, posted, fresh=True, now_s=0.0)
    assert numbered(post(box, b"2")) == [("s/uuid.1/1", 1, "s")]


def test_one_that_comes_back_before_its_end_was_told_has_its_stream_at_once(box):
    box.leave(ME)
    box.gone(ME, ends=True)
    box.arrive(ME, None, fresh=True, now_s=0.0)
    assert numbered(post(box, b"1")) == [("s/uuid.1/1", 1, "s")]


def test_one_that_begins_anew_while_it_is_thought_to_leave_has_a_stream_of_its_own(box):
    """It was adopted: whoever was to have it is gone for good."""
    post(box, b"1")
    posted = box.leave(ME)
    box.arrive(ME, posted, fresh=False, now_s=0.0)
    assert numbered(post(box, b"2")) == [("s/uuid.1/2", 1, "s")]
    assert numbered(due(box, 100.0))[0] == ("s/uuid.1/1", 1, "s")


def test_a_thousand_moves_to_and_fro_leave_no_stream_behind():
    """Also where nobody acknowledges what the task sends in its end."""
    here, there = Outbox("s/uuid.1", "s"), Outbox("t/uuid.1", "t")
    gc.collect()
    before = sum(isinstance(it, Outgoing) for it in gc.get_objects())
    posted = None
    for _ in range(500):
        for box in (here, there):
            box.arrive(ME, posted, fresh=True, now_s=0.0)
            posted = box.leave(ME)
            box.gone(ME, ends=True)
            post(box, b"goodbye")
            box.ended(ME)
    gc.collect()
    assert sum(isinstance(it, Outgoing) for it in gc.get_objects()) == before
    assert here.waiting() == there.waiting() == {"a/Sink": 500}


def test_a_task_that_stays_goes_on_with_its_stream(box):
    post(box, b"1")
    box.leave(ME)
    box.stay(ME)
    assert numbered(post(box, b"2")) == [("s/uuid.1/1", 2, "s")]


def test_where_it_may_have_run_since_what_is_in_the_snapshot_comes_and_a_new_stream_begins(box):
    post(box, b"1", b"2")
    posted = box.leave(ME)
    there = Outbox("t/uuid.2", "t")
    there.arrive(ME, posted, fresh=False, now_s=0.0)
    again = due(there, 0.0)
    assert numbered(again) == [("s/uuid.1/1", 1, "t"), ("s/uuid.1/1", 2, "t")]
    assert numbered(post(there, b"other")) == [("t/uuid.2/1", 1, "t")]
    acknowledge(there, again[0], 2, epoch_n=1)
    assert there.waiting() == {"a/Sink": 1}


def test_a_task_that_fails_and_begins_anew_keeps_its_stream(box):
    posted = box.leave(ME)
    there = Outbox("t/uuid.1", "t")
    there.arrive(ME, posted, fresh=True, now_s=0.0)
    post(there, b"1", b"2")
    there.arrive(ME, posted, fresh=False, now_s=0.0)
    assert numbered(post(there, b"3")) == [("t/uuid.1/1", 3, "t")]


def test_a_stream_that_nobody_adds_to_is_forgotten_once_all_is_acknowledged(box):
    (letter,) = post(box, b"1")
    posted = box.leave(ME)
    there = Outbox("t/uuid.2", "t")
    there.arrive(ME, posted, fresh=False, now_s=0.0)
    acknowledge(there, letter, 1)
    there.take_unsent()
    there.post("", SINK, b"2", "c", 0.0)
    assert [getattr(sent, "peer", "") for sent in there.take_unsent()] == ["c"]


def test_stream_that_moves_tells_nothing_of_the_others():
    """The agent that it moves to learns its secret, and no other one of its old agent."""
    box = Outbox("s/uuid.1", "s", "0" * 32)
    post(box, b"1"), post(box, b"1", sender="s/Other")
    moved, other = box.leave(ME), box.leave("s/Other")
    assert moved is not None and other is not None
    secrets = [posted.stream.partition("#")[2] for posted in (moved, other)]
    assert len(set(secrets)) == 2 and all(len(secret) == 32 for secret in secrets)
    again = Outbox("s/uuid.1", "s", "1" * 32)
    post(again, b"1")
    begun = again.leave(ME)
    assert begun is not None and begun.stream != moved.stream, "it is drawn from the agent's secret"
