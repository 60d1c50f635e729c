"""The state machine of a link, fed with events and times."""

from __future__ import annotations

from itertools import pairwise

import msgpack
import pytest
from seeded import for_each

from pancakes.mesh.codec import RowEncoder, encode_link_message, frame, head_of, run_of
from pancakes.mesh.link import (
    MOST_UNANSWERED,
    Greeted,
    Heard,
    Link,
    LinkState,
    LinkTimes,
    Measured,
    Over,
    PacketsReceived,
    SendMessage,
    Up,
)
from pancakes.mesh.messages import VERSION, AgentSeen, Goodbye, Gossip, Hello, Ping, Pong, RefuseLink, Welcome
from pancakes.packet import Packet
from pancakes.util.timebase import Timebase


def hello(name, **more):
    values = {
        "version": VERSION,
        "fleet": "default",
        "role": "agent",
        "journal": f"journal of {name}",
        "boot": 1,
        **more,
    }
    return Hello(name=name, **values)


def run(*packets):
    head = head_of(packets[0])
    return run_of(head, [RowEncoder(head).encode(packet) for packet in packets])


def received(*packets):
    head = head_of(packets[0])
    return PacketsReceived(list(packets), len(run(*packets)) - len(head))


def wire(*messages):
    return frame([run(it) if isinstance(it, Packet) else encode_link_message(it) for it in messages])


def sent(actions):
    return frame([action.message for action in actions if isinstance(action, SendMessage)])


def rest(actions):
    return [action for action in actions if not isinstance(action, SendMessage)]


def opened(name="a", now_s=0.0, answers=False, **more):
    link = Link(hello(name, **more), LinkTimes(), now_s, answers)
    link.open(now_s)
    return link


def up(name="a", peer="b", now_s=0.0):
    link = opened(name, now_s)
    link.receive(wire(hello(peer)), now_s)
    if name < peer:
        link.admit(now_s)
    else:
        link.receive(wire(Welcome()), now_s)
    assert link.state is LinkState.UP
    return link


C = AgentSeen("c", "tcp://c:1")
PACKET = Packet("chat", "words", "b/c/d", "a", 0.0, 1, "hello")


def test_two_links_come_up_when_the_lower_name_says_welcome():
    a, b = Link(hello("a"), LinkTimes(), 0.0), Link(hello("b"), LinkTimes(), 0.0)
    from_a, from_b = a.open(0.0), b.open(0.0)
    assert rest(a.receive(sent(from_b), 0.1)) == [Greeted(hello("b"))]
    assert rest(b.receive(sent(from_a), 0.1)) == [Greeted(hello("a"))]
    assert a.state is b.state is LinkState.MET
    welcome = a.admit(0.2)
    assert rest(welcome) == [Up()]
    assert b.receive(sent(welcome), 0.3) == [Up()]
    assert a.state is b.state is LinkState.UP


def test_the_higher_name_cannot_welcome():
    link = opened("a")
    link.receive(wire(hello("b")), 0.0)
    (over,) = rest(link.receive(wire(Welcome()), 0.0))
    assert over.broken


def test_hello_and_welcome_may_come_in_one_chunk():
    link = opened("b")
    assert link.receive(wire(hello("a"), Welcome(), PACKET), 0.0) == [Greeted(hello("a")), Up(), received(PACKET)]


@pytest.mark.parametrize("last", [Goodbye("stop"), hello("b")])
def test_one_that_ends_with_its_hello_is_told_nothing(last):
    link = Link(hello("a"), LinkTimes(), 0.0, answers=True)
    assert link.receive(wire(hello("b"), last), 0.0)[0] == Greeted(hello("b"))
    assert link.answer(0.0) == []


def test_packets_and_messages_keep_their_order():
    link = up()
    actions = link.receive(wire(PACKET, PACKET, Gossip((C,)), PACKET) + wire(PACKET), 1.0)
    assert actions == [
        received(PACKET),
        received(PACKET),
        Heard(Gossip((C,))),
        received(PACKET),
        received(PACKET),
    ]


def test_frames_of_several_runs_are_read_whole_however_often_they_come():
    link = up()
    other = Packet("chat", "words", "b/c/e", "a", 0.0, 1, "hello")
    for messages in ((PACKET,), (PACKET, PACKET), (other, PACKET)):
        for _ in range(3):
            assert link.receive(wire(*messages), 1.0) == [received(it) for it in messages]
    assert link.receive(wire(PACKET) + wire(PACKET) + wire(other), 1.0) == [received(PACKET)] * 2 + [received(other)]


def test_the_packets_of_a_run_come_together():
    others = [Packet("chat", "words", "b/c/d", "a", 0.5, seq, {"n": seq}, ("b/c/d", 1)) for seq in range(2, 20)]
    assert up().receive(frame([run(PACKET, *others)]), 1.0) == [received(PACKET, *others)]


@pytest.mark.parametrize("early", [PACKET, Welcome(), Gossip(()), Ping(1), Pong(1, 0.0), Timebase()])
def test_nothing_may_come_before_the_hello(early):
    link = opened("b")
    over = link.receive(wire(early), 0.0)[-1]
    assert isinstance(over, Over) and over.broken
    assert link.state is LinkState.OVER


@pytest.mark.parametrize("early", [PACKET, Gossip(()), hello("a")])
def test_nothing_but_a_welcome_may_follow_the_hello(early):
    link = opened("b")
    over = link.receive(wire(hello("a"), early), 0.0)[-1]
    assert isinstance(over, Over) and over.broken


def test_what_came_before_the_fault_is_delivered_and_the_peer_is_told():
    came, refuse, over = up().receive(wire(PACKET, hello("b")), 1.0)
    assert came == received(PACKET)
    assert b"protocol" in refuse.message
    assert over.broken and over.reason == "b broke the protocol: a second hello came"


@pytest.mark.parametrize(
    ("more", "code", "logged", "told"),
    [
        (
            {"version": 1},
            "version",
            f"version {VERSION} of the protocol and the other side version 1",
            f"version {VERSION} of the protocol and is spoken to in version 1",
        ),
        ({"fleet": "east"}, "fleet", "a is of the fleet 'default' and b of 'east'", "it is not of the fleet 'east'"),
    ],
)
@pytest.mark.parametrize("answers", [False, True])
def test_strangers_are_refused_with_a_typed_reason(more, code, logged, told, answers):
    link = opened("a", answers=answers)
    refuse, over = link.receive(wire(hello("b", **more)), 0.0)
    assert (over.refusing, over.broken) == (code, False)
    assert logged in over.reason and told.encode() in refuse.message
    assert b"default" not in refuse.message and b"journal" not in refuse.message


def test_a_terminal_of_another_fleet_is_told_what_to_do():
    refuse, _ = opened("a", answers=True).receive(wire(hello("cli-1.a", fleet="east", role="client")), 0.0)
    assert b"it is not of the fleet 'east'; --fleet names another" in refuse.message


def test_the_side_that_was_dialled_answers_with_its_hello_and_sends_no_heartbeat_before():
    link = Link(hello("a"), LinkTimes(), 0.0, answers=True)
    assert link.open(0.0) == [] and link.due_s() == LinkTimes().hello_s
    assert link.tick(1.9) == []
    assert link.receive(wire(hello("b")), 1.9) == [Greeted(hello("b"))], "it is for the mesh to accept it"
    assert link.answer(1.9) == [SendMessage(encode_link_message(hello("a")))]
    assert link.answer(1.9) == []
    assert link.due_s() == pytest.approx(1.9 + LinkTimes().heartbeat_s)
    assert [type(action) for action in link.tick(2.5)] == [SendMessage]


def test_a_hello_of_another_version_may_have_any_form():
    link = opened("a")
    over = link.receive(frame([msgpack.packb([1, VERSION + 1, {"all": "new"}])]), 0.0)[-1]
    assert over.refusing == "version"


def test_being_refused_is_told_with_its_code():
    link = opened("a")
    _, over = link.receive(wire(hello("b"), RefuseLink("name", "the name a is taken")), 0.1)
    assert (over.refused, over.turned_away) == ("name", False) and "b refused" in over.reason


@pytest.mark.parametrize("words", [RefuseLink("name", "the name a is taken"), Goodbye("sleep", 30.0)])
def test_what_comes_before_the_hello_ends_the_link_and_counts_for_nothing(words):
    (over,) = opened("a").receive(wire(words), 0.1)
    assert (over.refused, over.goodbye, over.broken) == (None, None, False)
    assert over.turned_away == isinstance(words, RefuseLink)
    assert over.reason in (
        "what listens there refused the link: the name a is taken",
        "what listens there left before it said hello",
    )


def test_what_a_stranger_says_stands_in_one_line():
    (over,) = opened("a").receive(wire(RefuseLink("name", "no\n  0.000 error   all is lost")), 0.1)
    assert "\n" not in over.reason


def test_goodbye_says_for_how_long():
    (over,) = up().receive(wire(Goodbye("sleep", 30.0)), 1.0)
    assert over.goodbye == Goodbye("sleep", 30.0) and over.reason == "b sleeps for 30 s"
    (over,) = up().receive(wire(Goodbye("stop")), 1.0)
    assert over.reason == "b stopped"


def test_saying_goodbye_ends_the_link():
    link = up()
    actions = link.leave(Goodbye("sleep", 5.0), 1.0)
    assert sent(actions) == wire(Goodbye("sleep", 5.0))
    assert link.state is LinkState.OVER
    assert link.receive(wire(PACKET), 1.1) == link.tick(99.0) == link.leave(Goodbye("stop"), 1.2) == []
    assert link.refuse("full", "there is no room", 1.3) == []


def measured(*args):
    """Returns a link that is up, and whose first pings have been."""
    link = up(*args)
    assert sent(link.tick(0.0)) == wire(Ping(1))
    link.pace_s = LinkTimes().measure_s
    return link


def test_a_heartbeat_is_sent_when_nothing_else_was():
    link = measured()
    assert link.due_s() == 0.5 and link.tick(0.49) == []
    assert sent(link.tick(0.5)) == wire(Ping(2))
    link.sent_s = 0.9  # a packet went out
    assert link.due_s() == 1.4 and link.tick(1.0) == []
    assert sent(link.tick(1.4)) == wire(Ping(3))


def test_a_busy_link_is_measured_all_the_same():
    link = measured()
    now_s, pings = 0.0, 0
    while now_s < 20.0:
        now_s += 0.1
        link.sent_s = now_s
        link.receive(wire(PACKET), now_s)
        pings += len(link.tick(now_s))
    assert pings == 3


def test_the_round_trip_is_measured_by_the_token():
    link = up()
    link.tick(0.5)
    link.receive(wire(Pong(1, 0.0)), 0.58)
    assert link.rtt_s == pytest.approx(0.08)
    link.receive(wire(Pong(1, 0.0)), 0.9)
    link.receive(wire(Pong(77, 0.0)), 0.9)
    assert link.rtt_s == pytest.approx(0.08), "what was not asked says nothing"
    link.tick(1.08)
    link.receive(wire(Pong(2, 0.0)), 1.24)
    assert link.rtt_s == pytest.approx(0.09)


def test_a_ping_is_answered():
    assert sent(up().receive(wire(Ping(5)), 1.0)) == wire(Pong(5, 1.0))


def test_silence_of_two_seconds_ends_the_link_and_any_byte_is_life():
    link = up()
    assert rest(link.tick(1.9)) == []
    link.receive(wire(PACKET)[:1], 1.9)
    assert rest(link.tick(3.8)) == []
    assert ended(link, 3.9) == [Over("nothing was heard from b for 2 s")]


def test_what_waits_to_be_read_when_the_time_is_over_is_life():
    """A thread that had to wait after it looked which sockets are ready has not seen what has come since."""
    link = up()
    assert link.tick(2.0) == []
    assert link.due_s() <= 2.0, "it is looked at once more, at once"
    link.receive(wire(PACKET)[:1], 2.0)
    assert rest(link.tick(3.9)) == []
    assert ended(link, 4.0) == [Over("nothing was heard from b for 2 s")]


def ended(link, now_s):
    """What a link does whose time is over: it is looked at once more, after all has been read."""
    assert link.tick(now_s) == []
    assert link.due_s() <= now_s
    return link.tick(now_s)


def test_who_is_late_itself_waits_for_a_heartbeat_more_and_only_once():
    """As on a machine without a processor to spare: what the peer has sent may come right behind."""
    link = up()
    assert rest(link.tick(2.6)) == []
    assert link.due_s() <= 3.1
    link.receive(wire(PACKET)[:1], 3.0)
    assert rest(link.tick(4.9)) == [], "it was alive all the time"
    assert rest(link.tick(6.0)) == []
    assert rest(link.tick(6.6)) == [Over("nothing was heard from b for 2 s")]


def test_who_is_late_itself_does_not_turn_away_who_could_not_say_hello_in_time():
    link = opened()
    assert rest(link.tick(3.0)) == []
    assert link.tick(3.5) == [Over("no hello came within 2 s")]


def test_a_hello_is_waited_for_two_seconds_whatever_else_trickles_in():
    link = opened("a")
    link.receive(wire(hello("b"))[:3], 1.9)
    assert rest(link.tick(1.99)) == []
    assert link.tick(2.0) == [Over("no hello came within 2 s")]


def test_a_welcome_is_waited_for_until_an_older_link_may_have_died():
    link = opened("b")
    link.receive(wire(hello("a")), 0.0)
    for now_s in (1.0, 2.0, 3.0):
        link.receive(wire(Ping(1)), now_s)
        assert rest(link.tick(now_s)) == []
    link.receive(wire(Ping(2)), 3.9)
    assert link.tick(4.0) == [Over("a did not say welcome in 4 s")]


def test_link_message_limits():
    def check(case):
        message, fits = case
        actions = up().receive(frame([msgpack.packb(message)]), 1.0)
        assert [it for it in actions if isinstance(it, Over) and it.broken] == [] if fits else actions[-1].broken

    for_each(
        [
            ([4, 0], True),
            ([4, -1], False),
            ([4, 2**53], True),
            ([4, 2**53 + 1], False),
            ([6, "sleep", 0], True),
            ([6, "sleep", -1.0], False),
            ([6, "sleep", 1e9], True),
            ([6, "sleep", 1.1e9], False),
            ([3, "full", "x" * 1000], True),
            ([3, "full", "x" * 1001], False),
            ([7, [["c", "tcp://" + "x" * 248 + ":1", 0]]], True),
            ([7, [["c", "tcp://" + "x" * 249 + ":1", 0]]], False),
            ([7, [["c", "tcp://x:1", 1.5]] * 128], True),
            ([7, [["c", "tcp://x:1", 1.5]] * 129], False),
            ([7, [["c/d", "tcp://x:1", 0]]], False),
            ([7, [["c", "tcp://x:1", -1]]], False),
        ],
        check,
    )


def test_an_address_that_is_none_breaks_the_protocol():
    over = up().receive(wire(Gossip((C, AgentSeen("d", "tcp://c d:1")))), 1.0)[-1]
    assert over.broken and "'tcp://c d:1' is no address" in over.reason


def test_a_run_with_a_part_too_many_breaks_the_protocol():
    message = msgpack.unpackb(run(PACKET))
    assert up().receive(frame([msgpack.packb(message)]), 1.0) == [received(PACKET)]
    over = up().receive(frame([msgpack.packb([*message, 1])]), 1.0)[-1]
    assert isinstance(over, Over) and over.broken


def test_a_heartbeat_too_late_is_not_late_yet():
    """A link that is looked at just one heartbeat after its end is only looked at once more."""
    link = up()
    assert link.tick(2.5) == []
    assert link.tick(2.5)[-1:] == [Over("nothing was heard from b for 2 s")]


def test_the_higher_name_waits_for_pings_only_once_it_knows_the_round_trip():
    link = measured("b", "a")
    assert link.due_s() == 0.5
    link.tick(0.5)
    link.receive(wire(Pong(1, 0.0)), 0.6)
    assert link.due_s() == pytest.approx(0.5 + 0.6)


def test_the_first_packet_of_a_source_may_have_the_number_0():
    first = Packet("chat", "words", "b/c/d", "a", 0.0, 0, "hello", ("b/c/d", 0))
    assert up().receive(wire(first), 1.0) == [received(first)]


def test_only_a_client_may_have_a_dot_in_its_name():
    assert opened("a").receive(wire(hello("b.c", role="client")), 0.0) == [Greeted(hello("b.c", role="client"))]
    assert opened("a").receive(wire(hello("b.c")), 0.0)[-1].broken


# Clocks


def test_the_first_pings_follow_each_other_quickly_also_where_the_link_is_busy():
    link, pings, now_s = up(), [], 0.0
    while now_s < 25.0:
        now_s = link.sent_s = round(now_s + 0.01, 2)
        link.receive(wire(PACKET), now_s)
        if link.tick(now_s):
            pings.append(now_s)
    waits = [later - earlier for earlier, later in pairwise(pings)]
    assert pings[0] == 0.01
    assert waits[:4] == [pytest.approx(it, abs=0.011) for it in (0.1, 0.15, 0.225, 0.3375)]
    assert waits[-2:] == [pytest.approx(5.0, abs=0.011)] * 2
    link.hurry()
    link.sent_s = now_s
    assert link.due_s() == pytest.approx(max(pings) + 0.1)


def test_an_answer_says_when_a_ping_left_was_answered_and_came_back():
    link = up()
    assert sent(link.tick(0.1)) == wire(Ping(1))
    assert link.receive(wire(Pong(1, 77.5)), 0.13) == [Measured(0.1, 77.5, 0.13)]
    assert link.receive(wire(Pong(1, 78.5)), 0.14) == []
    assert link.receive(wire(Pong(9, 79.5)), 0.15) == []


def test_a_long_way_is_measured_with_the_first_pings_too():
    link = up()
    for number in range(1, MOST_UNANSWERED + 2):
        link.hurry()
        assert sent(link.tick(0.1 * number)) == wire(Ping(number))
    assert link.receive(wire(Pong(1, 5.0)), 1.0) == []
    assert link.receive(wire(Pong(2, 5.0)), 1.0) == [Measured(0.2, 5.0, 1.0)]


def test_the_clocks_of_a_peer_are_told():
    told = Timebase(12.0, 3.0, 2.0, 1.6e9)
    assert sent(up().tell(told, 1.0)) == wire(told)
    assert up().receive(wire(told), 1.0) == [Heard(told)]
    assert opened().tell(told, 1.0) == []


def test_impossible_answer_time_breaks_the_protocol():
    def check(bad):
        link = up()
        link.tick(0.1)
        actions = rest(link.receive(frame([msgpack.packb([5, 1, bad])]), 0.2))
        assert [type(action) for action in actions] == [Over] and actions[0].broken

    for_each([float("nan"), float("inf"), -1e13, 1e13, None, "1", True], check)


@pytest.mark.parametrize("at_s", [-1e12, 1e12])
def test_an_answer_may_have_any_time_that_a_clock_shows(at_s):
    link = up()
    link.tick(0.1)
    assert not any(isinstance(action, Over) for action in link.receive(frame([msgpack.packb([5, 1, at_s])]), 0.2))


def test_impossible_clocks_break_the_protocol():
    def check(row):
        actions = rest(up().receive(frame([msgpack.packb([10, *row])]), 0.2))
        assert [type(action) for action in actions] == [Over] and actions[0].broken

    for_each(
        [
            [float("nan"), 0.0, 1.0, None],
            [0.0, float("nan"), 1.0, None],
            [0.0, -1.0, 1.0, None],
            [0.0, 1e10, 1.0, None],
            [0.0, 0.0, 0.0, None],
            [0.0, 0.0, float("inf"), None],
            [0.0, 0.0, -1.0, None],
            [0.0, 0.0, 1.0, float("nan")],
            [1e13, 0.0, 1.0, None],
        ],
        check,
    )
