"""Mailboxes and turns where two threads meet: each interleaving that a second look is there for, forced."""

from collections import deque

import pytest
from kernel.actors import Actor, put_back
from msgspec import structs

from pancakes.events import LogLine
from pancakes.kernel import plan as plan_module
from pancakes.kernel import stream as stream_module
from pancakes.kernel.channel_queue import ChannelQueue
from pancakes.kernel.dispatch import Dispatcher
from pancakes.kernel.handlers import Period
from pancakes.kernel.keep import queue
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.task_timer import TaskTimer
from pancakes.packet import Packet


class ByHand(Dispatcher):
    """Notes whose turn is due, and gives none."""

    def __init__(self):
        self.due = []

    def ready(self, mailbox):
        self.due.append(mailbox)


def packet(text="x"):
    return Packet("system", "line", "a/client/S", "", 0.0, 1, LogLine("info", text))


@pytest.fixture
def dispatcher():
    return ByHand()


def failing():
    raise SystemExit(3)


def given(dispatcher, actor):
    """Gives the turn that is due, and returns whether another one is due after it."""
    mailbox = actor.actor_inbox
    assert dispatcher.due == [mailbox]
    dispatcher.due.clear()
    dispatcher.give_turn(mailbox, [])
    return dispatcher.due == [mailbox]


# Turns


@pytest.fixture
def actor(dispatcher):
    """Waits for its first turn."""
    return Actor(dispatcher, "a/client/A")


def test_a_turn_that_has_done_everything_is_followed_by_none(dispatcher, actor):
    assert not given(dispatcher, actor)
    assert actor.actor_inbox.take_token(), "nobody could give it another turn"


def test_what_a_turn_has_left_of_its_packets_is_for_another_turn(dispatcher, actor):
    mailbox = actor.actor_inbox
    waiting = mailbox.subscribe("system", {"line": queue(8)})
    actor.subscribe("system", "line", lambda packet: waiting.put(packet))
    assert not given(dispatcher, actor)
    waiting.put(packet())
    assert given(dispatcher, actor), "nobody will come to what waits, until something else comes"
    mailbox.paused = True
    assert not given(dispatcher, actor), "it stands still"


def test_a_message_that_comes_in_the_middle_of_a_turn_is_for_another_turn(dispatcher, actor):
    actor.do(lambda: actor.do(lambda: None))
    assert given(dispatcher, actor)
    assert not given(dispatcher, actor)


def test_what_comes_while_a_tick_goes_on_is_for_a_turn(dispatcher, actor):
    given(dispatcher, actor)
    ticked(actor, [])
    assert dispatcher.due == [actor.actor_inbox]


class Joined(deque):
    """Somebody puts one thing more in just after the first look at how much there is."""

    joins = None

    def __len__(self):
        number = super().__len__()
        join, self.joins = self.joins, None
        if join is not None:
            join()
        return number


def test_what_comes_after_the_look_at_how_much_waits_and_before_the_mark_is_for_another_turn(dispatcher, actor):
    heard = []
    waiting = actor.actor_inbox.subscribe("system", {"line": queue(8)})
    actor.subscribe("system", "line", lambda packet: heard.append(packet.body.text))
    given(dispatcher, actor)
    waiting.items = Joined()
    waiting.put(packet("one"))
    waiting.items.joins = lambda: waiting.put(packet("two"))
    assert given(dispatcher, actor)
    assert not given(dispatcher, actor)
    assert heard == ["one", "two"]


def test_the_one_packet_of_a_turn_is_counted_and_weighed_no_more(dispatcher, actor):
    mailbox, heard = actor.actor_inbox, []
    given(dispatcher, actor)
    for types in (("line",), ("line", "pose")):  # then the queue is one for several types
        for name in types:
            actor.subscribe("system", name, lambda packet: heard.append(packet.body.text))
        waiting = mailbox.subscribe("system", {name: queue(8) for name in types})
        waiting.put_heavy(packet(), 5000)
        assert not given(dispatcher, actor)
        assert (waiting.handled, len(waiting), waiting.dropped(), waiting.heavy_bytes) == (1, 0, 0, 0)
    assert heard == ["x"] * 3  # one handler, then two of them


def test_somebody_else_may_empty_a_queue_just_before_its_reader_takes_from_it(dispatcher, actor):
    waiting = actor.actor_inbox.subscribe("system", {"line": queue(8)})
    given(dispatcher, actor)
    waiting.items = Emptied()
    waiting.put(packet())
    assert not given(dispatcher, actor)
    assert not actor.actor_stopped.is_set() and actor.kernel.said == []


class Ended(Actor):
    def tick(self, tick):
        """Fails."""
        raise SystemExit(3)


def ticked(actor, deferred):
    """Gives a component that is at rest a turn that is one tick."""
    timer = TaskTimer(actor, "tick", Period(1.0))
    timer.arm(0.0, 0)
    assert actor.actor_inbox.take_token()
    actor.take_tick(timer, deferred)


def test_a_tick_s_turn_ends_as_any_other(dispatcher, actor):
    given(dispatcher, actor)
    done = []
    actor.after_turn = lambda: done.append("after the turn")
    deferred = [lambda: done.append("put off")]
    ticked(actor, deferred)
    assert done == ["after the turn", "put off"] and deferred == []


def test_who_ends_in_a_tick_keeps_the_token_for_the_successor(dispatcher):
    actor = Ended(dispatcher, "a/client/A")
    given(dispatcher, actor)
    actor.end_actor = lambda error: setattr(actor.actor_inbox, "component", None)
    ticked(actor, [])
    assert not actor.actor_inbox.take_token() and dispatcher.due == []


def test_a_turn_whose_end_fails_is_told_of_and_others_are_given(dispatcher, actor):
    actor.after_turn = failing
    assert not given(dispatcher, actor)
    (said,) = actor.kernel.said
    assert said.startswith("the end of a/client/A's turn failed: SystemExit: 3 at test_second_looks.py:")
    actor.do(lambda: None)
    assert dispatcher.due == [actor.actor_inbox]


def test_the_turn_of_an_actor_that_is_no_more_is_nobody_s(dispatcher, actor):
    actor.do(lambda: pytest.fail("it has ended"))
    actor.actor_inbox.component = None
    assert not given(dispatcher, actor)
    assert not actor.actor_inbox.take_token(), "what comes now waits for its successor"


def test_a_token_that_two_want_is_one_s():
    mailbox = Mailbox()
    assert not mailbox.take_token(), "nobody reads it yet"
    put_back(mailbox)
    assert mailbox.take_token() and not mailbox.take_token()
    put_back(mailbox)
    mailbox.held = True  # somebody has just taken it
    assert not mailbox.take_token()
    mailbox.held = False
    assert mailbox.take_token()
    mailbox.held = False  # he has not said so yet
    assert not mailbox.take_token()


# Mailboxes


class Emptied(deque):
    """Seems to have something in it, and somebody else takes it out first."""

    def popleft(self):
        self.clear()
        raise IndexError("pop from an empty deque")


def test_two_threads_may_clear_what_nobody_will_handle():
    mailbox = Mailbox()
    mailbox.control = Emptied(["a message"])
    mailbox.clear_control()
    assert mailbox.empty()


def test_a_reader_may_take_the_oldest_while_room_is_made_for_a_heavy_packet():
    waiting = ChannelQueue(Mailbox(), "system", {"line": queue(1)})
    waiting.items = Emptied([packet()], maxlen=1)
    waiting.put_heavy(heavy := packet("heavy"), 5000)
    assert list(waiting.items) == [heavy] and waiting.heavy_bytes == 5000


def test_a_heavy_packet_that_was_pushed_out_and_comes_again_weighs_no_more_than_once():
    waiting = ChannelQueue(Mailbox(), "system", {"line": queue(1)})
    heavy = packet("heavy")
    waiting.put_heavy(heavy, 5000)
    waiting.put(packet())
    waiting.put_heavy(heavy, 5000)
    assert waiting.heavy_bytes == 5000


def test_a_queue_in_which_much_comes_is_listed_once():
    mailbox = Mailbox()
    waiting = mailbox.subscribe("system", {"line": queue(8)})
    for _ in range(3):
        waiting.put(packet())
    assert mailbox.waiting == [waiting]


def test_who_subscribes_again_as_before_keeps_the_queue():
    """What a publisher is about to put there would overtake what was moved out of it."""
    mailbox = Mailbox()
    first = mailbox.subscribe("system", {"line": queue(8)})
    assert mailbox.subscribe("system", {"line": queue(8)}) is first


# The stream


def test_whoever_makes_up_one_destination_after_the_other_does_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(stream_module, "MOST_ROUTES", 4)
    stream = stream_module.InformationStream("a")
    stream.gateway = lambda packet: None
    for number in range(20):
        for agent in ("a", "b"):
            stream.publish(structs.replace(packet(), type="line", destination=f"{agent}/client/T{number}"))
    assert 0 < len(stream._routes) <= 4


def test_classes_that_are_made_one_after_the_other_are_not_all_remembered():
    before = plan_module.plan_of.cache_info()
    assert before.maxsize == plan_module.MOST_PLANS
