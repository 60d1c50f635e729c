"""What a turn publishes leaves together, in the order of its source."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.errors import LocalProtocolError, PeerLost
from pancakes.net.outbox import PeerBusy
from pancakes.net.sending import Sending
from pancakes.net.session import BATCH_BYTES
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.wire.framing import frame
from pancakes.wire.runs import messages_from_payload, packets_of


class Peer:
    """Takes what a session would."""

    def __init__(self) -> None:
        self.congested = False
        self.sent: list[list[Any]] = []
        self.offered: list[Any] = []
        self.full = False

    def send(self, trains):
        messages = messages_from_payload(frame([train.message() for train in trains])[4:])
        self.sent.append([packet for run in messages for packet in packets_of(run)])

    def offer(self, channel, key, message):
        if self.full:
            raise PeerBusy("it is slow")
        self.offered.append(message)

    def got(self):
        return [packet for batch in self.sent for packet in batch]


class Turn:
    """A turn of a task: what it puts off is done at its end."""

    def __init__(self) -> None:
        self.deferred: list[Any] = []

    def defer(self, function):
        self.deferred.append(function)

    def end(self):
        deferred, self.deferred = self.deferred, []
        for function in deferred:
            function()


@pytest.fixture
def turn():
    return Turn()


@pytest.fixture
def peers():
    return {"b": Peer(), "c": Peer()}


@pytest.fixture
def sending(turn, peers):
    return made(turn, peers)


def made(turn, peers):
    def find(packet):
        raise PeerLost(f"{packet.destination} is away")

    sending = Sending(find, turn.defer if turn is not None else lambda function: function())
    sending.change(peers, tuple(peers.values()))
    return sending


def packet(seq, to="b/x", kind="words", body="hello", channel="chat"):
    return Packet(channel, kind, "a/client/T", to, 0.0, seq, body)


def test_a_turn_makes_one_send_for_each_peer(sending, turn, peers):
    for seq in range(10):
        sending.send(packet(seq, "b/x" if seq % 2 else "c/x"))
    assert not peers["b"].sent, "not before the turn ends"
    turn.end()
    assert [[it.seq for it in batch] for batch in peers["b"].sent] == [[1, 3, 5, 7, 9]]
    assert [[it.seq for it in batch] for batch in peers["c"].sent] == [[0, 2, 4, 6, 8]]
    turn.end()
    assert len(peers["b"].sent) == 1


def test_outside_of_a_turn_each_packet_leaves_at_once(peers):
    sending = made(None, peers)
    assert sending.send(packet(1)) == 1 and sending.send(packet(2, NEIGHBOURS)) == 2
    assert [it.seq for it in peers["b"].got()] == [1, 2]


@given(st.lists(st.tuples(st.sampled_from(["b/x", "b/y", "c/x", NEIGHBOURS]), st.sampled_from("st")), max_size=40))
def test_whatever_is_published_arrives_once_and_in_order(its):
    turn, peers = Turn(), {"b": Peer(), "c": Peer()}
    sending = made(turn, peers)
    for seq, (to, kind) in enumerate(its):
        sending.send(packet(seq, to, kind))
    turn.end()
    for name, peer in peers.items():
        wanted = [seq for seq, (to, _) in enumerate(its) if to == NEIGHBOURS or to.startswith(name)]
        assert [it.seq for it in peer.got()] == wanted


def test_a_turn_does_not_pile_up_what_could_be_on_its_way(sending, turn, peers):
    for seq in range(100):
        sending.send(packet(seq, body=bytes(1000)))
    early = peers["b"].got()
    assert len(early) >= 100 - BATCH_BYTES // 1000
    turn.end()
    assert [it.seq for it in peers["b"].got()] == list(range(100))


def test_what_a_slow_peer_is_offered_goes_behind_what_was_published_before(sending, turn, peers):
    sending.send(packet(1))
    peers["b"].congested = True
    assert sending.send(packet(2)) == 1
    assert [it.seq for it in peers["b"].got()] == [1] and len(peers["b"].offered) == 1
    peers["b"].full = True
    with pytest.raises(PeerBusy):
        sending.send(packet(3))
    assert sending.send(packet(4, NEIGHBOURS)) == 1, "to neighbours it is not given, and nobody is told"
    turn.end()
    assert len(peers["b"].got()) == 1


def test_what_cannot_travel_or_has_no_way_is_told_to_the_publisher(sending, turn, peers):
    with pytest.raises(LocalProtocolError, match="set"):
        sending.send(packet(1, body={1}))
    with pytest.raises(PeerLost, match="away"):
        sending.send(packet(2, "nobody/x"))
    turn.end()
    assert peers["b"].sent == []


def test_other_links_are_other_ways(sending, turn, peers):
    sending.send(packet(1))
    turn.end()
    newer = Peer()
    sending.change({"b": newer}, (newer,))
    sending.send(packet(2))
    turn.end()
    assert [it.seq for it in peers["b"].got()] == [1] and [it.seq for it in newer.got()] == [2]
    sending.change({}, ())
    with pytest.raises(PeerLost):
        sending.send(packet(3))
    assert sending.send(packet(4, NEIGHBOURS)) == 0
