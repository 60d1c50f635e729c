"""Membership: which agents are dialled, when, and which connection stays."""

from __future__ import annotations

import math
import random

import pytest

from pancakes.mesh.link import LinkTimes
from pancakes.mesh.messages import Goodbye, Hello
from pancakes.mesh.peers import (
    FORGET_AFTER,
    MAX_AGENTS,
    MAX_CLIENTS,
    MAX_LEARNT,
    MOST_DIALS,
    MOST_OF_PEER,
    AddressBook,
    Admit,
    Dial,
    Peers,
    TurnDown,
    reachable,
)


def hello(name, listen=None, **more):
    values = {"version": 1, "fleet": "f", "role": "agent", "journal": f"journal of {name}", "boot": 1, **more}
    return Hello(name=name, listen=(f"tcp://{name}:1",) if listen is None else tuple(filter(None, [listen])), **values)


def peers(*static, own="m", seed=1):
    return Peers(hello(own), static, random.Random(seed), LinkTimes(), 0.0)


def connect(it, name, now_s=0.0, **more):
    """A connection from `name` comes in and comes to stand."""
    link = it.new_link()
    it.on_hello(link, hello(name, **more), "tcp://there:9", now_s)
    it.on_link_up(link, now_s)
    return link


def addresses(it):
    return [known["address"] for known in it.book.describe()]


def dials(decisions):
    return [decision.address for decision in decisions if isinstance(decision, Dial)]


def test_all_static_addresses_are_dialled_side_by_side_at_once():
    it = peers("tcp://a:1", "tcp://b:1", "tcp://m:1")
    assert it.due_s() == 0.0
    assert dials(it.tick(0.0)) == ["tcp://a:1", "tcp://b:1"], "but not its own"
    assert it.tick(5.0) == [] and it.due_s() == math.inf, "a dial under way is not doubled"


def test_an_agent_is_awaited_until_a_dial_to_it_has_failed_or_it_is_there():
    it = peers("tcp://a:1")
    assert it.book.are_awaited()
    (dial,) = it.tick(0.0)
    it.on_link_over(dial.link, 0.0)
    assert not it.book.are_awaited()
    it = peers("tcp://a:1")
    (dial,) = it.tick(0.0)
    it.on_hello(dial.link, hello("a"), "tcp://a:1", 0.0)
    it.on_link_up(dial.link, 0.0)
    assert not it.book.are_awaited()
    assert not peers().book.are_awaited()


def test_waits_double_from_a_tenth_of_a_second_to_ten_seconds_with_full_jitter():
    bounds = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0]
    waits: list[list[float]] = [[] for _ in bounds]
    for seed in range(200):
        it, now_s = peers("tcp://a:1", seed=seed), 0.0
        for wait in waits:
            (dial,) = it.tick(now_s)
            it.on_link_over(dial.link, now_s)
            wait.append(it.due_s() - now_s)
            now_s = it.due_s()
    for bound, wait in zip(bounds, waits, strict=True):
        assert 0.9 * bound < max(wait) <= bound
        assert min(wait) < 0.1 * bound


def test_a_connected_agent_is_not_dialled_under_any_of_its_addresses():
    it = peers("tcp://a:1", "tcp://alias:1")
    one, two = it.tick(0.0)
    assert it.on_hello(one.link, hello("z", "tcp://a:1"), "tcp://a:1", 0.0) == [Admit(one.link)]
    it.on_link_up(one.link, 0.0)
    it.on_hello(two.link, hello("z", "tcp://a:1"), "tcp://alias:1", 0.0)
    it.on_link_over(two.link, 0.0, refused="duplicate")
    assert it.tick(100.0) == []
    it.on_link_over(one.link, 100.0)
    assert sorted(dials(it.tick(101.0))) == ["tcp://a:1", "tcp://alias:1"]


def test_the_lower_name_admits_and_the_higher_waits():
    it = peers(own="m")
    assert it.on_hello(it.new_link(), hello("z"), "", 0.0) == [Admit(1)]
    assert it.on_hello(it.new_link(), hello("a"), "", 0.0) == []


def test_our_own_dial_goes_before_the_others():
    it = peers("tcp://z:1")
    (mine,) = it.tick(0.0)
    theirs = it.new_link()
    assert it.on_hello(theirs, hello("z"), "", 0.1) == [], "it waits"
    assert it.on_hello(mine.link, hello("z"), "tcp://z:1", 0.2) == [Admit(mine.link)]
    (turned,) = it.on_link_up(mine.link, 0.2)
    assert isinstance(turned, TurnDown) and (turned.link, turned.code) == (theirs, "duplicate")


def test_the_others_dial_is_taken_where_ours_fails():
    it = peers("tcp://z:1")
    (mine,) = it.tick(0.0)
    theirs = it.new_link()
    it.on_hello(theirs, hello("z"), "", 0.1)
    it.on_link_over(mine.link, 0.2)
    assert it.due_s() <= 0.2
    assert Admit(theirs) in it.tick(0.2)


def test_the_others_dial_is_taken_where_ours_takes_too_long():
    it = peers("tcp://z:1")
    it.tick(0.0)
    theirs = it.new_link()
    it.on_hello(theirs, hello("z"), "", 0.1)
    assert it.tick(0.5) == [] and it.due_s() == 0.6
    assert it.tick(0.6) == [Admit(theirs)]


def test_a_second_connection_waits_until_the_first_shows_life():
    it = peers()
    first = connect(it, "z")
    second = it.new_link()
    assert it.on_hello(second, hello("z"), "", 1.0) == []
    (turned,) = it.on_bytes(first)
    assert (turned.link, turned.code) == (second, "duplicate")


def test_a_second_connection_is_taken_when_the_first_dies():
    it = peers()
    first = connect(it, "z")
    second = it.new_link()
    it.on_hello(second, hello("z"), "", 1.0)
    assert it.on_link_over(first, 2.0) == [Admit(second)]


def test_of_two_connections_that_wait_the_newest_is_taken():
    it = peers()
    first, second, third = connect(it, "z"), it.new_link(), it.new_link()
    it.on_hello(second, hello("z"), "", 1.0)
    it.on_hello(third, hello("z"), "", 1.1)
    assert it.on_link_over(first, 2.0) == [Admit(third)]


def test_no_dial_is_due_before_the_last_one_failed():
    for seed in range(20):
        it = peers("tcp://a:1", seed=seed)
        (dial,) = it.tick(0.0)
        it.on_link_over(dial.link, 7.0)
        assert 7.0 <= it.due_s() <= 7.1


def test_a_dial_of_our_own_beside_a_link_is_needless():
    it = peers("tcp://alias:1")
    (dial,) = it.tick(0.0)
    connect(it, "z")
    (turned,) = it.on_hello(dial.link, hello("z"), "tcp://alias:1", 0.1)
    assert (turned.link, turned.code) == (dial.link, "duplicate")


def test_a_later_boot_replaces_the_old_link_and_an_earlier_one_is_refused():
    it = peers()
    old = connect(it, "z", boot=2)
    new = it.new_link()
    turned, admitted = it.on_hello(new, hello("z", boot=3), "", 1.0)
    assert (turned.link, turned.code) == (old, "old") and admitted == Admit(new)
    (late,) = it.on_hello(it.new_link(), hello("z", boot=1), "", 1.0)
    assert late.code == "old"


def test_the_higher_name_follows_the_choice_of_the_lower():
    it = peers(own="m")
    first, second = it.new_link(), it.new_link()
    it.on_hello(first, hello("a"), "", 0.0)
    it.on_link_up(first, 0.0)
    it.on_hello(second, hello("a"), "", 1.0)
    (turned,) = it.on_link_up(second, 1.0)
    assert (turned.link, turned.code) == (first, "duplicate")
    assert it.on_link_over(first, 1.0, refused="duplicate") == []
    assert [peer.name for peer in it.connected()] == ["a"]


def test_another_journal_under_a_connected_name_is_refused_by_either_side():
    for own in ("a", "z"):
        it = peers(own=own)
        connect(it, "m")
        (turned,) = it.on_hello(it.new_link(), hello("m", journal="another"), "", 1.0)
        assert turned.code == "name" and "name m" in turned.reason


@pytest.mark.parametrize("journal", ["a disk", "z disk"])
def test_another_journal_is_refused_also_where_both_connections_met_before_one_stood(journal):
    it = peers(own="z")
    first, second = it.new_link(), it.new_link()
    it.on_hello(first, hello("m"), "", 0.0)
    it.on_hello(second, hello("m", journal=journal), "", 0.0)
    assert it.on_link_up(first, 0.1) == []
    (turned,) = it.on_link_up(second, 0.2)
    assert (turned.link, turned.code) == (second, "name")


def test_a_new_journal_is_taken_once_the_old_one_has_gone():
    it = peers()
    it.on_link_over(connect(it, "z"), 1.0)
    assert it.on_hello(it.new_link(), hello("z", journal="a new disk"), "", 2.0) == [Admit(2)]


def test_we_notice_when_we_dial_ourselves_and_look_again_now_and_then():
    it = peers("tcp://alias:1")
    (dial,) = it.tick(0.0)
    (turned,) = it.on_hello(it.new_link(), hello("m"), "tcp://there:9", 0.0)  # at its other end
    assert turned.code == "self"
    (turned,) = it.on_hello(dial.link, hello("m"), "tcp://alias:1", 0.0)
    assert turned.code == "self"
    it.on_link_over(dial.link, 0.0, refused="self")
    assert addresses(it) == [] and it.tick(9.9) == []
    (dial,) = it.tick(10.0)
    it.on_hello(dial.link, hello("z", listen="tcp://alias:1"), "tcp://alias:1", 10.0)
    assert addresses(it) == ["tcp://alias:1"], "another agent is there now"


def test_an_address_at_which_a_program_repeats_our_hello_is_not_ours():
    it = peers("tcp://squatter:1")
    (dial,) = it.tick(0.0)
    (turned,) = it.on_hello(dial.link, hello("m"), "tcp://squatter:1", 0.0)
    assert (turned.code, turned.reason) == ("name", "the program there repeats what m sends")
    it.on_link_over(dial.link, 0.0, refused="name")
    (known,) = it.book.describe()
    assert (known["address"], known["refused"]) == ("tcp://squatter:1", turned.reason)
    assert dials(it.tick(10.0)) == ["tcp://squatter:1"]


def test_a_newcomer_that_finds_its_name_taken_waits_to_be_told():
    it = peers("tcp://rival:1")
    (dial,) = it.tick(0.0)
    assert it.on_hello(dial.link, hello("m", journal="another journal"), "tcp://rival:1", 0.0) == []
    assert "the name m is already taken by another agent" in it.book.describe()[0]["refused"]


def test_who_says_that_it_listens_at_a_static_address_keeps_nobody_from_dialling_it():
    it = peers("tcp://true:1")
    (dial,) = it.tick(0.0)
    it.on_link_over(dial.link, 0.0)
    connect(it, "z", listen="tcp://true:1")
    assert dials(it.tick(10.0)) == ["tcp://true:1"]


def test_addresses_are_learnt_dialled_and_spread_but_never_those_of_clients():
    it = peers()
    assert dials(it.on_addresses(["tcp://c:1", "tcp://m:1", ""], 0.0)) == ["tcp://c:1"]
    connect(it, "z")
    connect(it, "y", role="client")
    connect(it, "x", role="environment")
    connect(it, "w", listen="")
    assert it.gossip() == [("x", ("tcp://x:1",), 0.0), ("z", ("tcp://z:1",), 0.0)]
    assert "tcp://y:1" not in addresses(it)


def test_the_book_of_learnt_addresses_is_bounded():
    it = peers("tcp://a:1")
    it.on_addresses([f"tcp://x:{number}" for number in range(10_000)], 0.0)
    assert len(addresses(it)) == MAX_LEARNT + 1


def test_of_each_peer_so_many_addresses_are_kept_at_which_no_agent_is_connected():
    it = peers()
    named = [f"tcp://x:{number}" for number in range(1, 40)]
    it.on_addresses(named, 0.0, "a")
    assert addresses(it) == named[:MOST_OF_PEER]
    it.on_addresses(named, 0.0, "b")
    assert addresses(it) == named[: 2 * MOST_OF_PEER], "each peer has a count of its own"
    connect(it, "z", listen=named[0])
    it.on_addresses(named[35:37], 0.0, "a")
    assert addresses(it) == [*named[: 2 * MOST_OF_PEER], named[35]], "z is there, so a may name one more"


def test_so_many_learnt_addresses_are_dialled_at_a_time_and_each_static_one_at_once():
    it = peers("tcp://s:1")
    first = dials(it.on_addresses([f"tcp://x:{number}" for number in range(1, 17)], 0.0, "a"))
    assert first == ["tcp://s:1", *(f"tcp://x:{number}" for number in range(1, MOST_DIALS + 1))]
    assert it.tick(0.0) == [] and it.due_s() == math.inf
    it.on_link_over(2, 0.0)
    assert it.due_s() <= 0.0
    assert dials(it.tick(0.0)) == [f"tcp://x:{MOST_DIALS + 1}"]


def test_a_peer_may_name_no_address_that_must_be_looked_up_and_a_person_may():
    it = Peers(hello("m"), (), random.Random(1), LinkTimes(), 0.0, may_be_named=lambda address: "name" not in address)
    it.on_addresses(["tcp://name:1", "tcp://192.0.2.1:1"], 0.0, "a")
    assert addresses(it) == ["tcp://192.0.2.1:1"]
    it.on_hello(it.new_link(), hello("z", listen="tcp://name:2"), "tcp://there:9", 0.0)
    assert addresses(it) == ["tcp://192.0.2.1:1"]
    it.on_addresses(["tcp://name:1"], 0.0)
    assert addresses(it) == ["tcp://192.0.2.1:1", "tcp://name:1"]


def test_a_learnt_address_that_always_fails_is_forgotten_a_static_one_never():
    it, now_s = peers("tcp://static:1"), 0.0
    it.on_addresses(["tcp://learnt:1"], now_s)
    for _ in range(FORGET_AFTER * 2):
        for it_dial in it.tick(now_s):
            it.on_link_over(it_dial.link, now_s)
        it.on_link_over(1, now_s)
        it.on_link_over(2, now_s)
        now_s += 11.0
    assert addresses(it) == ["tcp://static:1"]


@pytest.mark.parametrize("refused", ["version", "fleet", "name", "full"])
def test_who_refuses_us_for_good_is_asked_at_the_longest_interval(refused):
    it = peers("tcp://a:1")
    (dial,) = it.tick(0.0)
    it.on_link_over(dial.link, 0.0, refused=refused)
    assert it.due_s() == 10.0


def test_who_breaks_the_protocol_is_not_dialled_again_at_once():
    it = peers("tcp://a:1")
    (dial,) = it.tick(0.0)
    it.on_hello(dial.link, hello("a"), "", 0.0)
    it.on_link_up(dial.link, 0.0)
    it.on_link_over(dial.link, 100.0, broken=True)
    assert it.due_s() == 110.0


def test_a_link_that_flaps_waits_longer_each_time_one_that_lasted_begins_anew():
    it, now_s = peers("tcp://a:1"), 0.0

    def live_for(seconds):
        nonlocal now_s
        now_s = it.due_s()
        (dial,) = it.tick(now_s)
        it.on_hello(dial.link, hello("a"), "", now_s)
        it.on_link_up(dial.link, now_s)
        now_s += seconds
        it.on_link_over(dial.link, now_s)
        (known,) = it.book.describe()
        return known["failures"]

    assert [live_for(0.1), live_for(0.1), live_for(60.0), live_for(0.1)] == [1, 2, 0, 1]


def test_a_sleeper_is_left_alone_until_it_should_be_back():
    it = peers("tcp://z:1")
    (dial,) = it.tick(0.0)
    it.on_hello(dial.link, hello("z"), "", 0.0)
    it.on_link_up(dial.link, 0.0)
    it.on_link_over(dial.link, 5.0, goodbye=Goodbye("sleep", 30.0))
    assert it.asleep(6.0) == {"z": 29.0}
    assert it.due_s() == 35.0
    assert it.asleep(35.0) == {}
    connect(it, "z", 20.0)
    assert it.asleep(20.0) == {}, "it came back early"


def test_of_those_that_sleep_for_ever_so_many_are_remembered():
    it = peers()
    for number in range(MAX_LEARNT + 5):
        it.on_link_over(connect(it, f"z{number}"), 1.0, goodbye=Goodbye("sleep"))
    asleep = it.asleep(2.0)
    assert len(asleep) == MAX_LEARNT
    assert "z4" not in asleep and "z5" in asleep


def test_who_has_been_met_is_not_dialled_again_before_it_says_whether_it_sleeps():
    it = peers("tcp://a:1")
    (dial,) = it.tick(0.0)
    assert it.on_hello(dial.link, hello("a"), "", 0.0) == [], "the lower name has the say"
    assert it.tick(0.1) == [] and it.due_s() == math.inf
    it.on_link_over(dial.link, 0.2, goodbye=Goodbye("sleep", 30.0))
    assert it.tick(30.1) == []
    assert dials(it.tick(30.2)) == ["tcp://a:1"]


def test_who_sleeps_without_an_end_or_stops_is_asked_seldom():
    for goodbye in (Goodbye("sleep"), Goodbye("stop")):
        it = peers("tcp://z:1")
        (dial,) = it.tick(0.0)
        it.on_hello(dial.link, hello("z"), "", 0.0)
        it.on_link_up(dial.link, 0.0)
        it.on_link_over(dial.link, 5.0, goodbye=goodbye)
        assert it.due_s() == 15.0
        assert it.asleep(1e6) == ({"z": math.inf} if goodbye.why == "sleep" else {})


def test_after_waking_up_all_are_dialled_at_once():
    it, now_s = peers("tcp://a:1", "tcp://b:1"), 0.0
    for _ in range(10):
        for dial in it.tick(now_s):
            it.on_link_over(dial.link, now_s)
        now_s += 10.0
    it.redial(now_s)
    assert len(dials(it.tick(now_s))) == 2


def test_a_mesh_has_its_bounds():
    it = peers(own="a")
    for number in range(MAX_AGENTS - 1):
        assert connect(it, f"b{number}")
    (turned,) = it.on_hello(it.new_link(), hello("c"), "", 0.0)
    assert turned.code == "full"
    assert it.on_hello(it.new_link(), hello("d", role="client"), "", 0.0) == [Admit(MAX_AGENTS + 1)]


def test_a_terminal_links_to_more_agents_than_an_agent_does():
    it = Peers(hello("0", role="client"), (), random.Random(1), LinkTimes(), 0.0)
    for number in range(MAX_AGENTS + 10):
        connect(it, f"n{number}")
    assert it.on_hello(it.new_link(), hello("z"), "", 0.0) == [Admit(MAX_AGENTS + 11)]


def full_of_clients(quiet_s):
    """An agent with all the clients that it takes, each on a machine of its own."""
    quiet: dict[int, float] = {}
    it = Peers(hello("a"), (), random.Random(1), LinkTimes(), 0.0, lambda link, now_s: quiet[link])
    for number in range(MAX_CLIENTS):
        link = it.new_link()
        quiet[link] = quiet_s
        it.on_hello(link, hello(f"cli{number:02}", "", role="client"), f"tcp://10.0.0.{number}:9", 0.0)
        it.on_link_up(link, 0.0)
    return it


def test_a_client_that_only_answers_pings_gives_its_place_to_the_next():
    it = full_of_clients(math.inf)
    link = it.new_link()
    turned, admitted = it.on_hello(link, hello("d", "", role="client"), "tcp://10.0.1.1:9", 0.0)
    assert isinstance(turned, TurnDown) and (turned.link, turned.code) == (1, "full") and "full" in turned.reason
    assert admitted == Admit(link)


def test_where_all_clients_are_busy_the_next_is_told_so_unless_it_is_at_the_agents_own_machine():
    it = full_of_clients(0.1)
    (turned,) = it.on_hello(it.new_link(), hello("d", "", role="client"), "tcp://10.0.1.1:9", 0.0)
    assert (turned.link, turned.code) == (MAX_CLIENTS + 1, "full") and "64 clients" in turned.reason
    link = it.new_link()
    made_room, admitted = it.on_hello(link, hello("e", "", role="client"), "tcp://127.0.0.1:9", 0.0)
    assert (made_room.link, admitted) == (1, Admit(link))


def test_the_sentence_with_which_an_agent_refuses_us_is_kept_until_it_takes_us():
    it = peers("tcp://z:1")
    (dial,) = it.tick(0.0)
    it.on_hello(dial.link, hello("z"), "", 0.0)
    it.on_link_over(dial.link, 0.0, refused="full", refusal="z is full")
    assert [(known["name"], known["refused"]) for known in it.book.describe()] == [("z", "z is full")]
    (dial,) = it.tick(10.0)
    it.on_hello(dial.link, hello("z"), "", 10.0)
    it.on_link_up(dial.link, 10.0)
    assert [known["refused"] for known in it.book.describe()] == [""]


@pytest.mark.parametrize(
    ("listen", "remote", "address"),
    [
        ("tcp://10.0.0.1:7401", "tcp://10.0.0.9:555", "tcp://10.0.0.1:7401"),
        ("tcp://0.0.0.0:7401", "tcp://10.0.0.9:555", "tcp://10.0.0.9:7401"),
        ("tcp://[::]:7401", "tcp://[fe80::1]:555", "tcp://[fe80::1]:7401"),
        ("tcp://0.0.0.0:7401", "tcp://[::ffff:127.0.0.1]:555", "tcp://127.0.0.1:7401"),
        ("tcp://[0::0]:7401", "tcp://10.0.0.9:555", "tcp://10.0.0.9:7401"),
        ("tcp://[::ffff:10.0.0.9]:7401", "tcp://10.0.0.9:555", "tcp://10.0.0.9:7401"),
        ("tcp://[fe80::1%wlan0]:7401", "tcp://[fe80::1%eth0]:555", "tcp://[fe80::1%eth0]:7401"),
        ("tcp://[fe80::1%wlan0]:7401", "tcp://[::1]:555", "tcp://[fe80::1%wlan0]:7401"),
        ("tcp://[fe80::1%wlan0]:7401", "tcp://10.0.0.9:555", ""),
        ("tcp://[fe80::1%wlan0]:7401", "tcp://[fe80::2%eth0]:555", ""),
        ("tcp://0.0.0.0:7401", "", ""),
        ("", "tcp://10.0.0.9:555", ""),
    ],
)
def test_who_listens_everywhere_is_dialled_where_it_was_seen(listen, remote, address):
    assert reachable(listen, remote) == address


def test_the_end_of_one_link_leaves_the_dials_to_other_agents_alone():
    it = peers("tcp://a:1", "tcp://b:1")
    first, second = it.tick(0.0)
    it.on_hello(first.link, hello("a"), "", 0.0)
    it.on_link_up(first.link, 0.0)
    it.on_link_over(first.link, 5.0, goodbye=Goodbye("stop"))
    assert it.tick(5.0) == [], "b is being dialled still, and a is left alone for a while"
    it.on_link_over(second.link, 6.0)
    assert it.due_s() < 7.0


def test_a_link_that_breaks_soon_is_dialled_again_at_once():
    it = peers("tcp://a:1")
    (dial,) = it.tick(0.0)
    it.on_hello(dial.link, hello("a"), "", 0.0)
    it.on_link_up(dial.link, 0.0)
    it.on_link_over(dial.link, 0.5)
    assert 0.5 <= it.due_s() <= 0.6


@pytest.mark.parametrize("address", ["tcp://c:1", "tcp://b:1", "no address"])
def test_an_address_that_a_peer_may_not_name_is_no_news(address: str) -> None:
    book = AddressBook(
        ("tcp://b:1",), (), random.Random(1), LinkTimes(), 0.0, lambda name: False, lambda named: named == "tcp://a:1"
    )
    assert not book.learn(address, 0.0, by="peer")
    assert book.learn("tcp://a:1", 0.0, by="peer")
    assert [known for known, _ in book.items()] == ["tcp://a:1"]
