"""The mailbox: bounded, in the order of each channel, kept between a task and its successor."""

import sys
import threading
from collections import deque
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel.actors import bounded, drained, put, put_back, take
from pykka import ActorDeadError, ActorRef

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import LATEST, QueuePolicy, drop_oldest, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.payload_size import LIGHT_BYTES
from pancakes.kernel.pykka_actor import Flag
from pancakes.packet import Packet


def packet(seq, type_name="pose", channel="system"):
    return Packet(channel, type_name, "a/client/T", "", 0.0, seq, None)


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
    waiting = bounded(opened(), "system", {"pose": LATEST})
    for seq in range(1, 6):
        put(waiting, packet(seq))
    assert waiting.dropped() == 0
    assert drained(waiting) == [5]


def test_a_queue_lets_the_oldest_fall_out():
    waiting = bounded(opened(), "system", {"pose": drop_oldest(3)})
    for seq in range(1, 6):
        put(waiting, packet(seq))
    assert drained(waiting) == [3, 4, 5]
    assert waiting.dropped() == 2


def test_a_reliable_queue_says_that_it_is_full_and_loses_nothing():
    waiting = bounded(opened(), "system", {"pose": reliable(2)})
    assert not waiting.of("pose").refuses(0)
    put(waiting, packet(1))
    put(waiting, packet(2))
    assert waiting.of("pose").refuses(0)
    assert drained(waiting) == [1, 2]
    assert waiting.dropped() == 0


def test_two_types_on_one_channel_never_overtake_each_other():
    waiting = bounded(opened(), "system", {"pose": drop_oldest(9), "battery": drop_oldest(9)})
    for seq, name in enumerate(["pose", "battery", "battery", "pose", "battery"], start=1):
        put(waiting, packet(seq, name))
    assert drained(waiting) == [1, 2, 3, 4, 5]


def test_each_type_on_a_channel_has_its_own_bound():
    waiting = bounded(opened(), "system", {"pose": LATEST, None: drop_oldest(9)})
    for seq, name in enumerate(["pose", "battery", "pose", "load", "pose"], start=1):
        put(waiting, packet(seq, name))
    assert drained(waiting) == [2, 4, 5]  # of the poses only the newest, in its place


def test_a_packet_that_comes_again_is_first_and_is_not_counted_twice():
    for bounds in ({"pose": reliable(9)}, {"pose": reliable(9), "load": LATEST}):
        waiting = bounded(opened(), "system", bounds)
        for seq in (1, 2, 3):
            put(waiting, packet(seq))
        waiting.of("pose").put_back(take(waiting))
        waiting.of("pose").put_back(take(waiting))
        assert drained(waiting) == [1, 2, 3]
        assert waiting.dropped() == 0


def test_one_turn_is_asked_for_however_much_comes_meanwhile():
    mailbox = opened()
    waiting = bounded(mailbox, "system", {"pose": drop_oldest(9)})
    put(waiting, packet(1))
    put(waiting, packet(2))
    mailbox.put(object())
    assert mailbox.dispatch.told == 1


def test_a_second_subscription_on_a_channel_keeps_what_waits():
    mailbox = opened()
    put(bounded(mailbox, "system", {"pose": drop_oldest(9)}), packet(1))
    waiting = bounded(mailbox, "system", {"pose": drop_oldest(9), "load": LATEST})
    put(waiting, packet(2, "load"))
    assert drained(waiting) == [1, 2]


def test_a_successor_that_subscribes_one_type_after_the_other_loses_nothing():
    """A task that was stopped and started subscribes anew, method by method; its mailbox is the old one."""
    mailbox = opened()
    waiting = bounded(mailbox, "system", {"pose": LATEST, "load": drop_oldest(9)})
    for seq in (1, 2, 3):
        put(waiting, packet(seq, "load"))
    put(waiting, packet(4, "pose"))
    bounded(mailbox, "system", {"pose": LATEST})
    after = bounded(mailbox, "system", {"pose": LATEST, "load": drop_oldest(9)})
    assert drained(after) == [1, 2, 3, 4]


def test_the_count_of_what_fell_out_outlives_a_restart():
    mailbox = opened()
    waiting = bounded(mailbox, "system", {"pose": drop_oldest(2)})
    for seq in range(3):
        put(waiting, packet(seq))
    bounded(mailbox, "system", {"pose": drop_oldest(2)})
    assert mailbox.dropped() == 1
    # And so it does where one more type is listened to, also where the new queue alone is asked.
    other = bounded(mailbox, "system", {"load": drop_oldest(9)})
    assert mailbox.dropped() == other.dropped() == 1


def test_a_mailbox_that_waits_for_its_first_component_is_open():
    assert not Mailbox().closed


def test_a_caller_of_an_actor_that_has_ended_is_told_so_at_once(kernel):
    component = kernel.spawn(ActorCore, "a/client/C")
    ref = component.actor_ref
    ref.stop()
    # As a caller does that has looked at the actor before it ended.
    component.actor_stopped = Flag()
    late = ActorRef(component)
    with pytest.raises(ActorDeadError, match="anybody there"):
        late.ask("anybody there?", timeout=0)
    late.stop(timeout=0)


def test_a_thread_that_waits_for_the_end_of_an_actor_waits_as_long_as_it_takes():
    ended, woken = Flag(), []
    waits = threading.Thread(target=lambda: woken.append(ended.wait()))
    waits.start()
    ended.set()
    waits.join(10.0)
    assert woken == [True]
    assert ended.wait(0.0)
    assert not Flag().wait(0.0)


KEEPS = st.one_of(st.just(LATEST), st.builds(QueuePolicy, st.integers(1, 4)), st.builds(reliable, st.integers(1, 4)))
BOUNDS = st.dictionaries(st.sampled_from(["pose", "load", None]), KEEPS, min_size=1)
STEPS = st.lists(st.sampled_from(["put pose", "put load", "pop", "subscribe again"]), max_size=60)


def test_a_packet_that_is_put_back_is_not_taken_for_one_that_has_fallen_out():
    waiting = bounded(opened(), "system", {"pose": drop_oldest(2), "load": reliable(9)})
    for seq in (1, 2, 3):
        put(waiting, packet(seq, "load"))
    taken = take(waiting)
    for seq in (4, 5, 6):
        put(waiting, packet(seq))
    waiting.of("load").put_back(taken)
    assert drained(waiting) == [1, 2, 3, 5, 6]
    assert waiting.dropped() == 1


@given(BOUNDS, STEPS)
def test_any_queue_behaves_as_its_model(bounds, steps):
    """The model is a plain list: the oldest of the same bound falls out; all else stays in order."""
    mailbox = opened()
    waiting = bounded(mailbox, "system", bounds)
    model: deque[tuple[int, Any]] = deque()
    dropped = 0
    for seq, step in enumerate(steps):
        what, _, name = step.partition(" ")
        if what == "subscribe":
            # As a successor does: one type after the other.
            so_far = {}
            for type_name, keep in bounds.items():
                so_far[type_name] = keep
                waiting = bounded(mailbox, "system", dict(so_far))
        elif what == "pop":
            taken = take(waiting)
            assert (taken.seq if taken else None) == (model.popleft()[0] if model else None)
        else:
            bound = name if name in bounds else None
            if bound not in bounds:
                continue  # this type has no subscriber, so the stream never puts it here
            same = [entry for entry in model if entry[1] == bound]
            full = len(same) >= bounds[bound].limit
            assert waiting.of(name).refuses(0) == (bounds[bound].reliable and full)
            if bounds[bound].reliable and full:
                continue  # the stream asks first
            if full:
                model.remove(same[0])
                dropped += bounds[bound] != LATEST
            model.append((seq, bound))
            put(waiting, packet(seq, name))
        assert len(waiting) == len(model)
        assert mailbox.dropped() == dropped
    assert drained(waiting) == [seq for seq, _ in model]


def test_a_packet_that_comes_before_the_token_is_given_back_gets_a_turn():
    mailbox = opened()
    waiting = bounded(mailbox, "system", {None: LATEST})
    mailbox.token.acquire()
    put(waiting, packet(1))  # the turn has seen that nothing waits, and does not end before this
    assert mailbox.dispatch.told == 0
    mailbox.end_turn()
    assert mailbox.dispatch.told == 1


def test_a_paused_mailbox_asks_for_no_turn_before_it_goes_on():
    mailbox = opened()
    waiting = bounded(mailbox, "system", {None: drop_oldest(9)})
    mailbox.paused = True
    for seq in (1, 2):
        put(waiting, packet(seq))
    assert mailbox.dispatch.told == 0
    mailbox.token.acquire()  # the turn in which it goes on
    mailbox.paused = False
    mailbox.end_turn()
    assert mailbox.dispatch.told == 1


@pytest.mark.parametrize("keep", [LATEST, drop_oldest(3), drop_oldest(10_000)], ids=["latest", "3", "10,000"])
def test_many_publishers_and_one_reader_at_once_lose_no_newest_packet_and_no_count(keep):
    mailbox = opened()
    waiting = bounded(mailbox, "system", {"pose": keep, "load": keep})
    heavy, each = LIGHT_BYTES + 1, 10_000
    starts = threading.Barrier(4)

    def publish(name, weight):
        starts.wait()
        for seq in range(1, each + 1):
            put(waiting, Packet("system", name, f"a/client/{name}{weight}", "", 0.0, seq, None), weight)

    publishers = [threading.Thread(target=publish, args=kind) for kind in (("pose", 0), ("pose", heavy), ("load", 0))]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for publisher in publishers:
            publisher.start()
        starts.wait()
        heard: dict[str, list[int]] = {}
        while any(publisher.is_alive() for publisher in publishers) or mailbox.order:
            if (taken := mailbox.take()) is not None:
                heard.setdefault(taken.source, []).append(taken.seq)
    finally:
        sys.setswitchinterval(before)
    assert len(waiting) == 0 and waiting.heavy_bytes == 0
    assert all(seqs == sorted(set(seqs)) for seqs in heard.values())
    last = {source: seqs[-1] for source, seqs in heard.items()}
    poses = [last.get(f"a/client/pose{weight}", 0) for weight in (0, heavy)]  # all of one may have been replaced
    assert max(poses) == last["a/client/load0"] == each
    assert waiting.handled == sum(map(len, heard.values()))
    if keep != LATEST:
        assert waiting.handled + waiting.dropped() == 3 * each
