"""Packets to a task: the books of the sender and of the receiver, event by event."""

from itertools import pairwise

import pytest
from migration.bad_networks import NAME, SCAN, STREAM, post_over_a_bad_network
from seeded import for_each

from pancakes.durable.courier import Outbox
from pancakes.durable.delivery import (
    ASKED,
    IN_FLIGHT,
    LONGEST_S,
    MOST_OF_SENDER,
    RESEND_S,
    STREAMS,
    WINDOW,
    WINDOW_BYTES,
    ForwardTo,
    Incoming,
    Letter,
    LostLetters,
    Outgoing,
    OutgoingLetter,
    Receipt,
    Seek,
    StreamsBegan,
    asked_now,
    false_name,
    name_to,
)
from pancakes.durable.record import TaskId
from pancakes.errors import MailboxFullError
from pancakes.packet import Packet


@pytest.fixture
def out():
    return Outgoing(STREAM, "me")


def post(out, count, now_s=0.0, task_id=SCAN):
    return [sent for _ in range(count) for sent in out.post(task_id, b"packet", task_id.birthplace, now_s)]


def receipt(seq, epoch_n=0):
    return Receipt("a/Scan", NAME, seq, epoch_n)


def seqs(dispatches):
    return [(it.peer, it.letter.seq) if isinstance(it, OutgoingLetter) else it for it in dispatches]


def began(seq, epoch_n, began_n, began_seq):
    return Receipt("a/Scan", NAME, seq, epoch_n, began_n, began_seq)


class TestWhatIsLost:
    """A task began anew where it is now, and a sender learns which letters it lacks."""

    @pytest.fixture
    def out(self):
        out = Outgoing(STREAM, "me")
        post(out, 10)
        out.acknowledged(began(8, 0, 0, 0), "a", 0.0)
        assert out.take_lost() == []
        return out

    def test_what_was_acknowledged_and_lies_beyond_its_state(self, out):
        out.forwarded(ForwardTo("a/Scan", "b", 1), "a", 0.0)
        out.acknowledged(began(9, 1, 1, 5), "b", 0.0)
        assert out.take_lost() == [LostLetters("a/Scan", 6, 8, "b")]
        out.acknowledged(began(10, 1, 1, 5), "b", 0.0)
        assert out.take_lost() == []

    def test_each_later_beginning_counts(self, out):
        out.forwarded(ForwardTo("a/Scan", "b", 1), "a", 0.0)
        out.acknowledged(began(9, 1, 1, 8), "b", 0.0)
        out.forwarded(ForwardTo("a/Scan", "c", 2), "b", 0.0)
        out.acknowledged(began(10, 2, 2, 7), "c", 0.0)
        assert out.take_lost() == [LostLetters("a/Scan", 8, 9, "c")]

    @pytest.mark.parametrize("upto", [8, 9, -1])
    def test_nothing_where_its_state_has_it_or_that_is_not_known(self, out, upto):
        out.forwarded(ForwardTo("a/Scan", "b", 1), "a", 0.0)
        out.acknowledged(began(9, 1, 1, upto), "b", 0.0)
        assert out.take_lost() == []

    def test_nothing_where_it_was_not_known_from_what_state_it_began_before(self):
        out = Outgoing(STREAM, "me")
        post(out, 10)
        out.acknowledged(receipt(8), "a", 0.0)
        out.forwarded(ForwardTo("a/Scan", "b", 1), "a", 0.0)
        out.acknowledged(began(9, 1, 1, 5), "b", 0.0)
        assert out.take_lost() == []

    def test_an_answer_says_so_without_an_acknowledgement(self, out):
        assert out.is_unsure_of("a/Scan", 1) and out.is_unsure_of("a/Scan", 0) and not out.is_unsure_of("b/X", 1)
        out.began(StreamsBegan("a/Scan", 1, {"another": 0}), "b")
        assert out.take_lost() == []
        out.began(StreamsBegan("a/Scan", 1, {NAME: 0}), "b")
        assert out.take_lost() == [LostLetters("a/Scan", 1, 8, "b")]
        assert not out.is_unsure_of("a/Scan", 0)

    def test_a_later_life_under_the_same_epoch_counts(self, out):
        out.began(StreamsBegan("a/Scan", 0, {NAME: 6}, 1), "a")
        assert out.take_lost() == [LostLetters("a/Scan", 7, 8, "a")]
        out.began(StreamsBegan("a/Scan", 0, {NAME: 5}, 1), "a")
        assert out.take_lost() == []

    def test_a_sender_that_moves_takes_along_what_it_knows(self, out):
        moved = Outgoing.of(out.posted(), "you")
        moved.forwarded(ForwardTo("a/Scan", "c", 2), "a", 0.0)
        moved.acknowledged(began(9, 2, 2, 3), "c", 0.0)
        assert moved.take_lost() == [LostLetters("a/Scan", 4, 8, "c")]

    def test_a_box_says_which_task_has_sent_them(self):
        box = Outbox("me/uuid.1", "me")
        for sender in ("", "me/Source"):
            box.post(sender, SCAN, b"packet", "a", 0.0)
        names = tuple(sent.letter.stream for sent in box.take_unsent() if isinstance(sent, OutgoingLetter))
        for name in names:
            box.acknowledged(Receipt("a/Scan", name, 1, 0, 0, 0), "a", 0.0)
        assert box.unsure_of("a/Scan", 3) == names
        box.began(StreamsBegan("a/Scan", 3, dict.fromkeys(names, 0)), "b")
        assert [(lost.sender, lost.first, lost.last) for lost in box.take_lost()] == [("", 1, 1), ("me/Source", 1, 1)]


class TestTheSender:
    def test_sends_at_once_and_numbers_each_tasks_letters_from_one(self, out):
        assert seqs(post(out, 2)) == [("a", 1), ("a", 2)]
        assert seqs(post(out, 1, task_id=TaskId("b", "Other"))) == [("b", 1)]
        assert out.waiting() == {"a/Scan": 2, "b/Other": 1}

    def test_sends_again_from_the_oldest_on_until_it_is_acknowledged(self, out):
        post(out, 3)
        assert out.due(RESEND_S * 0.9) == []
        assert seqs(out.due(RESEND_S)) == [("a", 1), ("a", 2), ("a", 3)]
        out.acknowledged(receipt(2), "a", RESEND_S)
        assert seqs(out.due(10.0)) == [("a", 3)]
        out.acknowledged(receipt(3), "a", 10.0)
        assert out.due(100.0) == [] and out.waiting() == {}

    def test_puts_it_off_for_longer_each_time_and_asks_everybody_in_the_end(self, out):
        post(out, 2)
        now_s = 0.0
        times_s: list[float] = []
        asked: list[list[str]] = []
        while len(asked) < 7:
            now_s += 0.05
            sent = out.due(now_s)
            if sent:
                times_s.append(now_s)
                asked.append([one.task_id for one in sent if isinstance(one, Seek)])
        pauses = [later_s - before_s for before_s, later_s in pairwise(times_s)]
        assert pauses == pytest.approx([0.3, 0.6, 1.2, 2.4, 2.4, 2.4], abs=0.06)
        assert max(pauses) == pytest.approx(LONGEST_S, abs=0.06)
        assert asked == [[], [], [], *[["a/Scan"]] * 4]

    def test_says_which_letters_will_never_come_again(self, out):
        post(out, 3)
        out.acknowledged(receipt(2), "a", 0.1)
        assert [sent.letter.first for sent in out.due(5.0)] == [3]
        assert post(out, 1)[0].letter.first == 3

    def test_has_no_more_than_so_many_on_their_way(self, out):
        assert len(post(out, IN_FLIGHT + 10)) == IN_FLIGHT
        assert seqs(out.acknowledged(receipt(3), "a", 0.1)) == [("a", IN_FLIGHT + n) for n in (1, 2, 3)]

    def test_refuses_more_than_the_window(self, out):
        post(out, WINDOW)
        with pytest.raises(MailboxFullError, match="1024 packets for the task a/Scan"):
            post(out, 1)
        assert out.waiting() == {"a/Scan": WINDOW}
        out.acknowledged(receipt(1), "a", 0.1)
        post(out, 1)

    def test_follows_a_task_that_moved_and_believes_no_older_news(self, out):
        post(out, 2)
        assert seqs(out.forwarded(ForwardTo("a/Scan", "b", 3), "a", 0.1)) == [("b", 1), ("b", 2)]
        assert out.forwarded(ForwardTo("a/Scan", "c", 2), "b", 0.1) == []
        assert out.forwarded(ForwardTo("a/Scan", "b", 3), "b", 0.1) == []
        assert seqs(post(out, 1)) == [("b", 3)]

    def test_believes_an_agent_only_that_it_has_asked(self, out):
        post(out, 1)
        assert out.forwarded(ForwardTo("a/Scan", "thief", 9), "thief", 0.1) == []
        asked = [("a", 1)]
        for round_ in range(1, 10):
            asked = seqs(out.due(10.0 * round_))
        assert asked == [("a", 1), Seek("a/Scan")], "nothing is heard of it, so all are asked"
        assert seqs(out.forwarded(ForwardTo("a/Scan", "b", 9), "c", 200.0)) == [("b", 1)]

    def test_believes_no_receipt_of_an_agent_that_it_sent_nothing(self, out):
        post(out, 2)
        out.acknowledged(receipt(2, epoch_n=4), "liar", 0.1)
        assert out.waiting() == {"a/Scan": 2}
        assert seqs(out.due(9.0)) == [("a", 1), ("a", 2)]

    def test_believes_no_receipt_of_a_former_stream(self, out):
        post(out, 2)
        out.acknowledged(Receipt("a/Scan", name_to("me/0#secret", "a/Scan"), 2, 0), "a", 0.1)
        assert out.waiting() == {"a/Scan": 2}

    def test_has_another_name_for_each_task(self, out):
        """Whoever gets letters to one of them could write to the other in this stream."""
        names = [post(out, 1, task_id=TaskId("a", name))[0].letter.stream for name in ("Scan", "Other")]
        assert names == [NAME, name_to(STREAM, "a/Other")] and len(set(names)) == 2
        assert all(name.startswith("me/1#") and "secret" not in name for name in names)


class TestTheReceiver:
    def test_takes_only_the_next_of_each_stream(self):
        filter_ = Incoming()
        assert filter_.is_next("x", 1, 1) and not filter_.is_next("x", 2, 1)
        filter_.took("x", 1)
        assert filter_.is_old("x", 1) and filter_.is_next("x", 2, 1) and filter_.is_next("y", 1, 1)

    def test_goes_on_after_what_was_acknowledged_and_is_forgotten(self):
        """A task without a checkpoint of each packet went back to an earlier one: what it said it had is not sent."""
        filter_ = Incoming({"x": 5})
        assert filter_.is_next("x", 11, 11) and not filter_.is_next("x", 12, 11)
        assert filter_.is_next("x", 6, 3)

    def test_what_it_heard_can_be_carried_elsewhere(self):
        filter_ = Incoming({"x": 5})
        filter_.took("y", 1)
        assert Incoming(filter_.heard()).is_old("x", 5)

    def test_forgets_the_stream_not_heard_from_for_longest(self):
        filter_ = Incoming()
        for number in range(STREAMS):
            filter_.took(f"s{number}", 1)
        filter_.took("s0", 2)
        filter_.took("new", 1)
        assert len(filter_.heard()) == STREAMS
        assert filter_.is_old("s0", 2) and not filter_.is_old("s1", 1)

    def test_agent_with_ever_new_streams_has_only_its_own_forgotten(self):
        filter_ = Incoming()
        filter_.took("honest", 5, "b")
        for number in range(2 * STREAMS):
            filter_.took(f"s{number}", 1, "c")
        assert filter_.is_old("honest", 5)
        assert len(filter_.heard()) == 1 + MOST_OF_SENDER


def test_post_over_a_bad_network_arrives_once_and_in_order():
    """More seeds: `test_post_full.py`."""
    for_each(range(3), post_over_a_bad_network)


def test_post_is_bounded_in_bytes_except_the_first():
    outgoing = Outgoing("s", "a")
    outgoing.post(SCAN, bytes(WINDOW_BYTES + 1), "b", 0.0)
    with pytest.raises(MailboxFullError, match=r"1 packets for the task a/Scan \(\d+ bytes\) wait"):
        outgoing.post(SCAN, b"x", "b", 0.0)
    outgoing.acknowledged(Receipt(str(SCAN), name_to("s", "a/Scan"), 1, 0), "b", 0.0)
    outgoing.post(SCAN, bytes(WINDOW_BYTES - 1), "b", 0.0)
    moved = Outgoing.of(outgoing.posted(), "c")
    moved.post(SCAN, b"x", "b", 0.0)
    with pytest.raises(MailboxFullError):
        moved.post(SCAN, b"x", "b", 0.0)


@pytest.mark.parametrize(
    ("sender", "source", "other"),
    [
        ("b", "b/client/T", ""),
        ("b", None, ""),
        ("c", "b/client/T", "c"),
        ("b/x", "b/client/T", "b/x"),
        ("b", "c/client/T", "c/client/T"),
        ("b", "bb/client/T", "bb/client/T"),
    ],
)
def test_letter_has_the_name_of_its_bringer(sender, source, other):
    packet = Packet("chat", "words", source, "task:a/Scan", 0.0, 1, None) if source else None
    assert false_name(Letter("a/Scan", STREAM, 1, 1, b"", sender), packet, "b") == other


@pytest.mark.parametrize("count", [0, 1, ASKED])
def test_asked_neighbours_are_all_if_they_are_few(count):
    names = [f"n{number:02d}" for number in range(count)]
    assert asked_now(names, 0.0) == asked_now(names, 10 * LONGEST_S) == names


def test_asked_neighbours_take_turns_if_they_are_many():
    names = [f"n{number:02d}" for number in range(5 * ASKED)]
    asked = [asked_now(names, (turn + 0.5) * LONGEST_S) for turn in range(5)]
    assert sorted(name for some in asked for name in some) == names
    assert asked_now(names, 2.1 * LONGEST_S) == asked_now(names, 2.9 * LONGEST_S) == asked[2]
    fewer = names[:-3]
    uneven = [asked_now(fewer, (turn + 0.5) * LONGEST_S) for turn in range(5)]
    assert {len(set(some)) for some in uneven} == {ASKED} and {name for some in uneven for name in some} == {*fewer}
