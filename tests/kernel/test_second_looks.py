"""Mailboxes and turns where two threads meet: each interleaving that a second look is there for, forced."""

import gc
from collections import deque

import pytest
from kernel.actors import Actor, bounded, put, put_back, take
from msgspec import structs

from pancakes.events import LogLine
from pancakes.kernel import handlers as plan_module
from pancakes.kernel import stream as stream_module
from pancakes.kernel.dispatchers import Dispatcher, defer
from pancakes.kernel.handlers import Subscription, drop_oldest
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.stream import Route
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
    dispatcher.give_turn(mailbox)
    return dispatcher.due == [mailbox]


# Turns


@pytest.fixture
def actor(dispatcher):
    """Waits for its first turn."""
    return Actor(dispatcher, "a/client/A")


def test_a_turn_that_has_done_everything_is_followed_by_none(dispatcher, actor):
    assert not given(dispatcher, actor)
    assert actor.actor_inbox.token.acquire(blocking=False), "no thread could give it another turn"


def test_what_a_turn_has_left_of_its_packets_is_for_another_turn(dispatcher, actor):
    mailbox = actor.actor_inbox
    waiting = bounded(mailbox, "system", {"line": drop_oldest(8)})
    actor.subscribe("system", "line", lambda packet: put(waiting, packet))
    assert not given(dispatcher, actor)
    put(waiting, packet())
    assert given(dispatcher, actor), "what waits is not handled until something else comes"
    mailbox.paused = True
    assert not given(dispatcher, actor), "it stands still"


def test_a_message_that_comes_in_the_middle_of_a_turn_is_for_another_turn(dispatcher, actor):
    actor.do(lambda: actor.do(lambda: None))
    assert given(dispatcher, actor)
    assert not given(dispatcher, actor)


def test_a_packet_that_comes_while_the_last_is_handled_is_for_another_turn(dispatcher, actor):
    heard = []
    waiting = bounded(actor.actor_inbox, "system", {"line": drop_oldest(8)})

    def hear(it):
        heard.append(it.body.text)
        if it.body.text == "one":
            put(waiting, packet("two"))

    actor.subscribe("system", "line", hear)
    given(dispatcher, actor)
    put(waiting, packet("one"))
    assert given(dispatcher, actor)
    assert not given(dispatcher, actor)
    assert heard == ["one", "two"]


def test_a_packet_that_was_taken_is_counted_and_weighed_no_more(dispatcher, actor):
    mailbox, heard = actor.actor_inbox, []
    given(dispatcher, actor)
    for name in ("line", "pose"):  # then the queue is one for several types
        actor.subscribe("system", name, lambda packet: heard.append(packet.body.text))
        waiting = bounded(mailbox, "system", {name: drop_oldest(8)})
        put(waiting, packet(), 5000)
        assert not given(dispatcher, actor)
        assert (len(waiting), waiting.dropped(), waiting.heavy_bytes) == (0, 0, 0)
    assert heard == ["x"] * 2 and waiting.handled == 2


def test_another_thread_may_empty_a_queue_just_before_its_reader_takes_from_it(dispatcher, actor):
    waiting = bounded(actor.actor_inbox, "system", {"line": drop_oldest(8)})
    given(dispatcher, actor)
    put(waiting, packet())
    take(waiting)
    assert not given(dispatcher, actor)
    assert not actor.actor_stopped.is_set() and actor.kernel.said == []


def test_what_a_turn_puts_off_is_done_at_its_end_also_what_that_puts_off(dispatcher, actor):
    given(dispatcher, actor)
    done = []
    actor.after_turn = lambda: done.append("after the turn")

    def put_off():
        done.append("put off")
        defer(lambda: done.append("again"))

    def turn():
        defer(put_off)
        done.append("turn")

    actor.do(turn)
    assert not given(dispatcher, actor)
    assert done == ["turn", "after the turn", "put off", "again"]
    defer(lambda: done.append("at once"))
    assert done[-1] == "at once"


def test_what_was_put_off_and_fails_is_told_of_and_the_rest_is_done(dispatcher, actor):
    given(dispatcher, actor)
    done = []

    def fail():
        raise ZeroDivisionError("division by zero")

    def turn():
        defer(fail)
        defer(lambda: done.append(1))

    actor.do(turn)
    assert not given(dispatcher, actor)
    assert done == [1]
    assert actor.kernel.said == ["what a turn of a/client/A had put off failed: ZeroDivisionError: division by zero"]


def test_a_turn_whose_end_fails_is_told_of_and_others_are_given(dispatcher, actor):
    actor.after_turn = failing
    assert not given(dispatcher, actor)
    (said,) = actor.kernel.said
    assert said.startswith("the end of a/client/A's turn failed: SystemExit: 3 at test_second_looks.py:")
    actor.do(lambda: None)
    assert dispatcher.due == [actor.actor_inbox]


def test_an_actor_that_is_no_more_gets_no_turn(dispatcher, actor):
    actor.do(lambda: pytest.fail("it has ended"))
    actor.actor_inbox.component = None
    assert not given(dispatcher, actor)
    assert not actor.actor_inbox.token.acquire(blocking=False), "what comes now waits for its successor"


def test_a_token_that_two_want_is_one_s(dispatcher):
    mailbox = Mailbox()
    mailbox.dispatch = dispatcher
    mailbox.wake()
    assert dispatcher.due == [], "no component reads it yet"
    put_back(mailbox)
    mailbox.wake()
    mailbox.wake()
    assert dispatcher.due == [mailbox]


# Mailboxes


class Emptied(deque):
    """Seems to have something in it, and another thread takes it out first."""

    def popleft(self):
        self.clear()
        raise IndexError("pop from an empty deque")


def test_two_threads_may_clear_what_no_actor_will_handle():
    mailbox = Mailbox()
    mailbox.control = Emptied(["a message"])
    mailbox.clear_control()
    assert not mailbox.control


def test_a_reader_that_subscribes_again_as_before_keeps_the_queue():
    """What a publisher is about to put there would overtake what was moved out of it."""
    mailbox = Mailbox()
    first = bounded(mailbox, "system", {"line": drop_oldest(8)})
    assert bounded(mailbox, "system", {"line": drop_oldest(8)}) is first


# The stream


def test_a_sender_that_makes_up_one_destination_after_the_other_does_not_fill_the_memory(monkeypatch):
    gc.collect()
    before = sum(isinstance(it, Route) for it in gc.get_objects())
    monkeypatch.setattr(stream_module, "MOST_ROUTES", 4)
    stream = stream_module.InformationStream("a")
    stream.subscribe("a/client/R", Mailbox(), Subscription("system", "line", drop_oldest(8)))
    stream.tap("system", lambda packet: None)
    stream.gateway = lambda packet: None
    for number in range(20):
        for agent in ("a", "b"):
            stream.publish(structs.replace(packet(), type="line", destination=f"{agent}/client/T{number}"))
    gc.collect()
    assert sum(isinstance(it, Route) for it in gc.get_objects()) <= before + 4


def test_classes_that_are_made_one_after_the_other_are_not_all_remembered():
    before = plan_module.plan_of.cache_info()
    assert before.maxsize == plan_module.MOST_PLANS
