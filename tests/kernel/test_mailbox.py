"""The mailbox: bounded, in the order of each channel, kept between a task and its successor."""

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel.actors import put_back
from pykka import ActorDeadError, ThreadingFuture
from pykka._envelope import Envelope
from pykka.messages import _ActorStop

from pancakes.kernel import shared_queue as module
from pancakes.kernel.keep import LATEST, Keep, queue, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import Packet


def packet(seq, type_name="pose", channel="system"):
    return Packet(channel, type_name, "a/client/T", "", 0.0, seq, None)


def drain(channel_queue):
    out = []
    while (taken := channel_queue.pop()) is not None:
        out.append(taken.seq)
    return out


class Dispatcher:
    """Counts how often it is told that a mailbox has work."""

    def __init__(self):
        self.told = 0

    def ready(self, mailbox):
        self.told += 1


def opened():
    """A mailbox whose component is between two turns."""
    mailbox = Mailbox()
    mailbox.dispatch = Dispatcher()
    put_back(mailbox)
    return mailbox


def test_latest_keeps_the_newest_and_has_lost_nothing():
    waiting = opened().subscribe("system", {"pose": LATEST})
    for seq in range(1, 6):
        waiting.put(packet(seq))
    assert waiting.dropped() == 0
    assert drain(waiting) == [5]
    assert waiting.offered() == 5


def test_a_queue_lets_the_oldest_fall_out():
    waiting = opened().subscribe("system", {"pose": queue(3)})
    for seq in range(1, 6):
        waiting.put(packet(seq))
    assert drain(waiting) == [3, 4, 5]
    assert waiting.dropped() == 2


def test_a_reliable_queue_says_that_it_is_full_and_loses_nothing():
    waiting = opened().subscribe("system", {"pose": reliable(2)})
    assert not waiting.full(packet(1))
    waiting.put(packet(1))
    waiting.put(packet(2))
    assert waiting.full(packet(3))
    assert drain(waiting) == [1, 2]
    assert waiting.dropped() == 0


def test_two_types_on_one_channel_never_overtake_each_other():
    waiting = opened().subscribe("system", {"pose": queue(9), "battery": queue(9)})
    for seq, name in enumerate(["pose", "battery", "battery", "pose", "battery"], start=1):
        waiting.put(packet(seq, name))
    assert drain(waiting) == [1, 2, 3, 4, 5]


def test_each_type_on_a_channel_has_its_own_bound():
    waiting = opened().subscribe("system", {"pose": LATEST, None: queue(9)})
    for seq, name in enumerate(["pose", "battery", "pose", "load", "pose"], start=1):
        waiting.put(packet(seq, name))
    assert drain(waiting) == [2, 4, 5]  # of the poses only the newest, in its place


def test_a_packet_that_comes_again_is_first_and_is_not_counted_twice():
    for bounds in ({"pose": reliable(9)}, {"pose": reliable(9), "load": LATEST}):
        waiting = opened().subscribe("system", bounds)
        for seq in (1, 2, 3):
            waiting.put(packet(seq))
        waiting.push_back(waiting.pop())
        waiting.push_back(waiting.pop())
        assert drain(waiting) == [1, 2, 3]
        assert waiting.dropped() == 0


def test_one_turn_is_asked_for_however_much_comes_meanwhile():
    mailbox = opened()
    waiting = mailbox.subscribe("system", {"pose": queue(9)})
    waiting.put(packet(1))
    waiting.put(packet(2))
    mailbox.put(object())
    assert mailbox.dispatch.told == 1


def test_a_second_subscription_on_a_channel_keeps_what_waits():
    mailbox = opened()
    mailbox.subscribe("system", {"pose": queue(9)}).put(packet(1))
    waiting = mailbox.subscribe("system", {"pose": queue(9), "load": LATEST})
    waiting.put(packet(2, "load"))
    assert drain(waiting) == [1, 2]


def test_a_successor_that_subscribes_one_type_after_the_other_loses_nothing():
    """A task that was stopped and started subscribes anew, method by method; its mailbox is the old one."""
    mailbox = opened()
    waiting = mailbox.subscribe("system", {"pose": LATEST, "load": queue(9)})
    for seq in (1, 2, 3):
        waiting.put(packet(seq, "load"))
    waiting.put(packet(4, "pose"))
    mailbox.subscribe("system", {"pose": LATEST})
    after = mailbox.subscribe("system", {"pose": LATEST, "load": queue(9)})
    assert drain(after) == [1, 2, 3, 4]


def test_the_count_of_what_fell_out_outlives_a_restart():
    mailbox = opened()
    waiting = mailbox.subscribe("system", {"pose": queue(2)})
    for seq in range(3):
        waiting.put(packet(seq))
    mailbox.subscribe("system", {"pose": queue(2)})
    assert mailbox.dropped() == 1
    # And so it does where one more type is listened to, also where the new queue alone is asked.
    other = mailbox.subscribe("system", {"load": queue(9)})
    assert mailbox.dropped() == other.dropped() == 1


def test_a_new_component_begins_with_what_its_predecessor_left():
    mailbox = opened()
    waiting = mailbox.subscribe("system", {"pose": queue(9)})
    waiting.put(packet(1))
    mailbox.waiting.clear()  # the predecessor had taken it off the list when it died
    mailbox.list_all()
    assert list(mailbox.waiting) == [waiting]


def test_who_asks_a_mailbox_that_nobody_reads_any_more_is_told_at_once():
    mailbox = opened()
    mailbox.closed = True
    question = ThreadingFuture()
    mailbox.put(Envelope("anybody there?", reply_to=question))
    with pytest.raises(ActorDeadError, match="anybody there"):
        question.get(timeout=0)
    stop = ThreadingFuture()
    mailbox.put(Envelope(_ActorStop(), reply_to=stop))
    assert stop.get(timeout=0) is None


KEEPS = st.one_of(st.just(LATEST), st.builds(Keep, st.integers(1, 4)), st.builds(reliable, st.integers(1, 4)))
BOUNDS = st.dictionaries(st.sampled_from(["pose", "load", None]), KEEPS, min_size=1)
STEPS = st.lists(st.sampled_from(["put pose", "put load", "pop", "subscribe again"]), max_size=60)


def test_what_has_fallen_out_of_a_shared_queue_is_soon_let_go():
    waiting = opened().subscribe("system", {"pose": LATEST, "load": queue(9)})
    for seq in range(1, 10_000, 2):
        waiting.put(packet(seq))
        waiting.put(packet(seq + 1, "load"))
    assert len(waiting) == 10
    assert len(waiting.items) <= 2 * (10 + module.SPARE), "its reader is held, and nobody else would do it"
    assert drain(waiting) == [*range(9984, 9999, 2), 9999, 10_000]
    assert waiting.dropped() == 5_000 - 9, "of the poses only the newest is wanted"


def test_a_packet_that_is_put_back_is_not_taken_for_one_that_has_fallen_out():
    waiting = opened().subscribe("system", {"pose": queue(2), "load": reliable(9)})
    for seq in (1, 2, 3):
        waiting.put(packet(seq, "load"))
    taken = waiting.pop()
    for seq in (4, 5, 6):
        waiting.put(packet(seq))
    waiting.push_back(taken)
    assert drain(waiting) == [1, 2, 3, 5, 6]
    assert waiting.dropped() == 1

    for seq in (1, 2):
        waiting.put(packet(seq))
    taken = waiting.pop()
    for seq in (3, 4):
        waiting.put(packet(seq))
    assert waiting.items[0].seq == 2, "it has fallen out, and is still there"
    waiting.push_back(taken)
    assert drain(waiting) == [1, 3, 4]


@pytest.mark.parametrize("spare", [0, 3, module.SPARE])
@given(BOUNDS, STEPS)
def test_any_queue_behaves_as_its_model(spare, bounds, steps):
    """The model is a plain list: the oldest of the same bound falls out; all else stays in order."""
    before, module.SPARE = module.SPARE, spare
    try:
        compare_with_model(bounds, steps)
    finally:
        module.SPARE = before


def compare_with_model(bounds, steps):
    mailbox = opened()
    waiting = mailbox.subscribe("system", bounds)
    model = deque()
    dropped = 0
    for seq, step in enumerate(steps):
        what, _, name = step.partition(" ")
        if what == "subscribe":
            # As a successor does: one type after the other.
            so_far = {}
            for type_name, keep in bounds.items():
                so_far[type_name] = keep
                waiting = mailbox.subscribe("system", dict(so_far))
        elif what == "pop":
            taken = waiting.pop()
            assert (taken.seq if taken else None) == (model.popleft()[0] if model else None)
        else:
            bound = name if name in bounds else None
            if bound not in bounds:
                continue  # nobody listens to this type, so the stream never puts it here
            same = [entry for entry in model if entry[1] == bound]
            full = len(same) >= bounds[bound].limit
            assert waiting.full(packet(seq, name)) == (bounds[bound].reliable and full)
            if bounds[bound].reliable and full:
                continue  # the stream asks first
            if full:
                model.remove(same[0])
                dropped += bounds[bound] != LATEST
            model.append((seq, bound))
            waiting.put(packet(seq, name))
        assert len(waiting) == len(model)
        assert mailbox.dropped() == dropped
    assert drain(waiting) == [seq for seq, _ in model]
