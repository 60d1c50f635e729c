"""Connections that a mesh refuses, and what a peer may do wrong without harm to the others."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from net.conftest import BarePeer
from net.meetings import message_of, pair, raw_hello

from pancakes.control import Channels
from pancakes.devices import Pose
from pancakes.mesh.codec import MAX_PAYLOAD_BYTES, encode_link_message, frame
from pancakes.mesh.link import LinkTimes
from pancakes.mesh.mesh import MAX_HANDSHAKES
from pancakes.mesh.messages import Goodbye, RefuseLink, Welcome
from pancakes.packet import Packet, type_name


def test_another_agent_of_the_same_name_is_refused_and_told_so(rig, agent):
    a, b = pair(rig, agent)
    impostor = agent("b", [a.address], journal="another journal")
    rig.until(lambda: "name b" in impostor.log("warning"))
    assert "another name" in impostor.log("warning")
    rig.until(lambda: "name b" in a.log("warning"))
    assert "name b" not in b.log("warning") and a.knows("b") and b.knows("a")


def test_an_agent_whose_name_is_taken_tries_again_until_it_is_free(rig, agent):
    a, b = pair(rig, agent)
    other = agent("b", [a.address], journal="another journal", times=LinkTimes(retry_longest_s=0.2))
    rig.until(lambda: "name b" in other.log("warning"))
    b.mesh.stop()
    rig.until(lambda: other.knows("a"))


def test_listening_agent_says_nothing_before_the_hello(rig, agent):
    a, quick = agent("a"), agent("quick", times=LinkTimes(hello_s=0.1))
    mute, stranger = rig.ear(), rig.ear()
    rig.transport("stranger").dial(quick.address, mute)
    rig.transport("stranger").dial(a.address, stranger)
    rig.until(lambda: mute.connection and stranger.connection)
    stranger.connection.send(raw_hello(fleet="another"))
    rig.until(lambda: mute.closed_for and stranger.closed_for)
    assert mute.data == b""
    journal = a.mesh.identity.journal
    assert b"another" in stranger.data and b"default" not in stranger.data and journal.encode() not in stranger.data


@pytest.mark.parametrize("channel", ["chat", "sysctrl", "ctrl", "log"])
def test_packets_under_another_name_are_dropped_and_logged(rig, agent, channel):
    """Under our own name, too. The packets that the peer sends for itself go on."""
    a = agent("a")
    for peer, source in (("0", "b/client/T"), ("1", "a/client/T"), ("2", "0b/client/T"), ("3", "x")):
        rig.transport(peer).dial(a.address, ear := rig.ear())
        rig.until(lambda ear=ear: ear.connection)
        order = Packet(channel, "words", source, "a", 0.0, 1, "stop")
        own = f"{peer}/c/T"
        sent = [message_of(order), message_of(replace(order, seq=2)), message_of(replace(order, source=own))]
        ear.connection.send(raw_hello(peer) + frame([encode_link_message(Welcome()), *sent]))
        rig.until(lambda own=own: a.packets and a.packets[-1].source == own)
        said = f"{peer} (agent) sends packets of {source} on {channel!r}, but may speak only for itself"
        assert said in a.log("warning")
    assert [packet.source for packet in a.packets] == ["0/c/T", "1/c/T", "2/c/T", "3/c/T"] and a.unfit == []
    assert [peer["refused"] for peer in a.mesh.describe()["peers"]] == [2, 2, 2, 2]


def test_a_peer_asks_for_a_thousand_things_at_once_and_no_more(rig, agent, monkeypatch):
    """What is no question is not counted. On a machine that has other work, so many more may come in the time."""
    rate = 1000 if rig.virtual else 10
    monkeypatch.setattr("pancakes.mesh.trust.MOST_ASKED_HZ", rate)
    a, ear = agent("a"), rig.ear()
    rig.transport("0").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    question = Packet("sysctrl", type_name(Channels), "0", "a", 0.0, 0, Channels())
    said = replace(question, channel="chat", type="words", body="said")
    sent = [message_of(replace(packet, seq=seq)) for packet in (question, said) for seq in range(1500)]
    ear.connection.send(raw_hello("0") + frame([encode_link_message(Welcome()), *sent]))
    rig.until(lambda: a.packets and (a.packets[-1].channel, a.packets[-1].seq) == ("chat", 1499))
    asked = [packet for packet in a.packets if packet.channel == "sysctrl"]
    assert rate <= len(asked) < 1500 and len(a.packets) == len(asked) + 1500
    refused = [
        packet.seq for _, packet, reason in a.unfit if reason == f"0 sends more than {rate} requests in a second"
    ]
    assert sorted([*(packet.seq for packet in asked), *refused]) == list(range(1500))


@pytest.mark.parametrize(("follows", "taken"), [(False, ["0/c/T"]), (True, ["b/client/T", "0/c/T"])])
def test_a_terminal_hears_what_others_say_and_an_agent_of_its_role_does_not(rig, agent, follows, taken):
    bare = BarePeer(rig.clock.now, "0")
    address = rig.transport("0").listen(rig.listen_at, lambda: bare)
    person = agent("z.1", [address], role="client", listen="", follows=follows)
    rig.until(lambda: bare.is_up)
    said = Packet("ctrl", "words", "b/client/T", "z", 0.0, 1, "go")
    bare.send(message_of(said), message_of(replace(said, source="0/c/T")))
    rig.until(lambda: person.packets and person.packets[-1].source == "0/c/T")
    assert [packet.source for packet in person.packets] == taken


def test_terminal_replays_others_but_no_command_and_no_log(rig, agent):
    a = agent("a")
    terminal = agent("cli.1", [a.address], role="client", listen="")
    rig.until(lambda: terminal.knows("a"))
    for channel in ("system", "chat", "ctrl", "log"):
        terminal.mesh.send(Packet(channel, "words", "b/client/T", "a", 0.0, 1, "said before"))
        terminal.mesh.send(Packet(channel, "words", "cli.1", "a", 0.0, 2, "said now"))
    rig.until(lambda: sum(packet.source == "cli.1" for packet in a.packets) == 4)
    replayed = {packet.channel for packet in a.packets if packet.source == "b/client/T"}
    assert replayed == {"system", "chat"} and len(a.packets) == 6


@pytest.mark.parametrize("words", [RefuseLink("name", "the name a is taken"), Goodbye("sleep", 3600.0)])
def test_what_is_said_before_any_hello_ends_no_agent_and_puts_off_no_dial(rig, agent, words):
    ears = []

    def squat():
        ears.append(rig.ear())
        return ears[-1]

    address = rig.transport("squatter").listen(rig.listen_at, squat)
    a = agent("a", [address])
    for attempt in (1, 2, 3):
        rig.until(lambda attempt=attempt: len(ears) == attempt and ears[-1].connection)
        ears[-1].connection.send(frame([encode_link_message(words)]))
    rig.until(lambda: len(ears) == 4)
    said = "refused the link: the name a is taken" if isinstance(words, RefuseLink) else "left before it said hello"
    assert said in a.log("warning") + a.log("info")
    assert a.mesh.describe()["state"] == "running" and a.mesh.describe()["asleep"] == []


def test_a_goodbye_under_the_name_of_an_agent_that_is_here_says_nothing_of_that_agent(rig, agent):
    a, b = pair(rig, agent)
    ear = rig.ear()
    rig.transport("b").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello("b", journal=b.mesh.identity.journal, boot=1))
    ear.connection.send(frame([encode_link_message(Goodbye("sleep", 3600.0))]))
    rig.until(lambda: ear.closed_for)
    assert a.knows("b") and a.mesh.describe()["asleep"] == []


def test_a_rival_with_a_later_boot_does_not_end_the_true_agent_which_comes_back(rig, agent):
    a, b = pair(rig, agent, times=LinkTimes(retry_longest_s=0.2))
    ear = rig.ear()
    rig.transport("b").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello("b", journal=b.mesh.identity.journal, boot=9))
    rig.until(lambda: b.downs)
    ear.connection.close("it has done what it came for")
    rig.until(lambda: b.ups == ["a", "a"])
    assert b.mesh.describe()["state"] == "running"


def test_an_impostor_gets_nothing_through_behind_its_hello(rig, agent, caplog):
    """All in one chunk: the hello, a welcome that is its to give, and an order."""
    a, ears = agent("a"), [rig.ear(), rig.ear()]
    order = Packet("sysctrl", "order", "0/x/y", "a", 0.0, 1, "stop")
    for ear, journal in zip(ears, ["the true one", "another"], strict=True):
        rig.transport("0").dial(a.address, ear)
        rig.until(lambda ear=ear: ear.connection)
        rest = frame([encode_link_message(Welcome()), message_of(order)])
        ear.connection.send(raw_hello("0", journal=journal) + rest)
        rig.until(lambda: len(a.packets) == 1)
    rig.until(lambda: ears[1].closed_for)
    assert len(a.packets) == 1 and a.ups == ["0"] and a.downs == []
    assert caplog.text == ""


def test_two_agents_of_one_name_refuse_each_other(rig, agent):
    first = agent("a")
    second = agent("a", [first.address], journal="another journal")
    rig.until(lambda: "name a" in second.log("warning"))
    assert f"no link over {first.address}" in second.log("warning")
    assert first.mesh.connected() == second.mesh.connected() == {}


@pytest.mark.parametrize("name", ["a", "b"])
def test_what_bears_the_name_of_another_is_told_nothing(rig, agent, name):
    a, _ = pair(rig, agent)
    ear = rig.ear()
    rig.transport(name).dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello(name, journal="another journal"))
    rig.until(lambda: ear.closed_for)
    assert b"is already taken by another agent" in ear.data
    assert a.mesh.identity.journal.encode() not in ear.data


def test_an_agent_that_dials_itself_notices(rig, agent):
    address = "tcp://alias:9"
    if rig.virtual:
        alone = agent("a", [address], listen=address)
    else:
        probe = rig.ear()
        address = rig.transport("probe").listen(rig.listen_at, lambda: probe)
        rig.close()
        alone = agent("a", [address.replace("127.0.0.1", "localhost")], listen=address)
        rig.until(lambda: not alone.mesh.describe()["addresses"])
    assert alone.mesh.connected() == {}


@pytest.mark.parametrize(("more", "word"), [({"fleet": "other"}, "fleet"), ({"version": 99}, "version")])
def test_other_fleets_and_versions_are_refused_with_a_reason(rig, agent, more, word):
    a, ear = agent("a"), rig.ear()
    rig.transport("intruder").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello(**more))
    rig.until(lambda: ear.closed_for)
    assert word.encode() in ear.data, "the other side was told why"
    rig.until(lambda: word in a.log("warning"))
    assert a.mesh.connected() == {}


GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    b"\xff\xff\xff\xff",
    (MAX_PAYLOAD_BYTES + 1).to_bytes(4, "big"),
    b"\0\0\0\0",
    b"\0\0\0\1\xc1",
    b"\0\0\0\1\x90",
    b"\0\0\0\3\x91\x91\xc0",
)


def test_garbage_closes_only_its_own_link(rig, agent):
    for garbage in GARBAGE:
        a, b = pair(rig, agent)
        rig.transport("intruder").dial(a.address, ear := rig.ear())
        rig.until(lambda ear=ear: ear.connection)
        ear.connection.send(garbage)
        rig.until(lambda ear=ear: ear.closed_for)
        rig.until(lambda a=a: "broke the protocol" in a.log("warning"))
        a.say("b", "unharmed")
        rig.until(lambda b=b: b.packets)
        assert a.downs == [], garbage


def test_a_packet_with_a_bad_body_is_told_and_costs_no_link(rig, agent):
    a, _ = pair(rig, agent)
    ear = rig.ear()
    rig.transport("intruder").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello())
    rig.until(lambda: a.knows("b", "intruder"))
    bad = Packet("system", "pose", "intruder/x/y", "a", 0.0, 1, {"x_m": "far", "y_m": 0.0, "theta_rad": 0.0})
    good = replace(bad, body=Pose(1.0, 2.0, 0.0), seq=2)
    not_its_own = replace(bad, source="b/x/y")
    ear.connection.send(frame([message_of(not_its_own)]) + frame([message_of(bad)]) + frame([message_of(good)]))
    rig.until(lambda: a.packets)
    ((peer, packet, reason),) = a.unfit
    assert (peer, packet) == ("intruder", replace(bad, body=None)) and "x_m" in reason
    assert a.packets == [good] and a.knows("b", "intruder") and not a.downs
    assert {it["name"]: it["packets_in"] for it in a.mesh.describe()["peers"]}["intruder"] == 3


def test_one_who_never_says_hello_is_closed(memory_rig):
    a, ear = memory_rig.agent("a"), memory_rig.ear()
    memory_rig.transport("mute").dial(a.address, ear)
    memory_rig.timeline.run_until(1.9)
    assert ear.connection is not None and ear.closed_for == []
    memory_rig.timeline.run_until(2.1)
    assert ear.closed_for == ["the other side closed the connection"]


def test_of_too_many_connections_the_oldest_that_said_no_hello_is_told_that_the_agent_is_full(memory_rig):
    a = memory_rig.agent("a")
    ears = [memory_rig.ear() for _ in range(MAX_HANDSHAKES + 6)]
    memory_rig.timeline.run_until(0.1)
    for ear in ears:
        memory_rig.transport("crowd").dial(a.address, ear)
    memory_rig.timeline.run_until(1.0)
    assert [bool(ear.closed_for) for ear in ears] == [True] * 6 + [False] * MAX_HANDSHAKES
    assert all(b"it is full: 256 connections" in ear.data for ear in ears[:6])
    assert "a is full: 256 connections" in a.log("warning")
    assert not any(b"a is full" in ear.data for ear in ears), "a stranger is not told the name"
    late = memory_rig.agent("late", [a.address])
    memory_rig.timeline.run_until(1.1)
    assert late.knows("a"), "at once, and not when the others have waited in vain"


def test_who_has_said_hello_goes_after_those_who_have_not(memory_rig):
    a = memory_rig.agent("m")
    memory_rig.timeline.run_until(0.1)
    polite, *mute = ears = [memory_rig.ear() for _ in range(MAX_HANDSHAKES + 1)]
    for ear in ears:
        memory_rig.transport("crowd").dial(a.address, ear)
        if ear is polite:
            memory_rig.until(lambda: polite.connection)
            # Its name is the lower one, so the link waits for its welcome.
            polite.connection.send(raw_hello("a"))
            memory_rig.timeline.run_until(0.2)
    memory_rig.timeline.run_until(0.5)
    assert not polite.closed_for and mute[0].closed_for and not mute[1].closed_for


def test_the_log_names_the_machine_of_a_connection_that_became_no_link(memory_rig):
    a = memory_rig.agent("a")
    memory_rig.transport("intruder").dial(a.address, ear := memory_rig.ear())
    memory_rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello(fleet="other"))
    memory_rig.until(lambda: ear.closed_for)
    assert "no link over a connection from tcp://127.0.0.1: a is of the fleet" in a.log("warning")


def test_an_agent_that_sleeps_dials_no_address_that_it_learns(memory_rig):
    a, b = memory_rig.agent("a"), memory_rig.agent("b")
    memory_rig.timeline.run_until(0.1)
    a.mesh.sleep()
    a.mesh.learn([b.address])
    memory_rig.timeline.run_until(30.0)
    assert b.lines == [] and not a.mesh.connected()
    a.mesh.wake()
    a.mesh.learn([b.address])
    memory_rig.until(lambda: a.knows("b"))
