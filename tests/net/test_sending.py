"""What a turn publishes leaves together, in the order of its source."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import Any

import msgspec
import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from pancakes.errors import LocalProtocolError, PeerLostError
from pancakes.mesh.codec import MAX_MESSAGE_BYTES, PacketRun, frame, messages_from_payload, packets_of, run_of
from pancakes.mesh.sending import MOST_WAYS, Sending, Way
from pancakes.mesh.session import BATCH_BYTES, PeerBusy
from pancakes.packet import NEIGHBOURS, Fence, Packet, packet_type


@packet_type("sending test level")
class Level(msgspec.Struct, frozen=True):
    level: float


def packets_in(whole: bytes) -> list[Packet]:
    """Returns the packets in a frame."""
    runs = [it for it in messages_from_payload(whole[4:]) if isinstance(it, PacketRun)]
    return [packet for run in runs for packet in packets_of(run)[0]]


class Peer:
    """Takes what a session would."""

    def __init__(self) -> None:
        self.congested = False
        self.sent: list[list[Any]] = []
        self.offered: list[Any] = []
        self.full = False
        self.retries = 0

    def send(self, trains):
        whole = frame([train.message() for train in trains])
        self.sent.append(packets_in(whole))
        self.retries += sum(train.retries for train in trains)

    def offer(self, channel, key, message):
        if self.full:
            raise PeerBusy("it is slow")
        self.offered.append(message)
        self.retries += not message.counts

    @property
    def taken(self):
        """What it was offered."""
        frames = [frame([run_of(it.head, [it.data])]) for it in self.offered]
        return [packet for it in frames for packet in packets_in(it)]

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
    def lost(packet):
        return PeerLostError(f"{packet.destination} is away")

    defer = turn.defer if turn is not None else lambda function: function()
    sending = Sending(lost, defer, seek=lambda agent: False)
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
    assert {len(batch) for batch in peers["b"].sent[:-1]} == {16}, "16 KiB at a time"
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
    assert sending.send(packet(4, NEIGHBOURS)) == 1, "to neighbours it is not given, and the sender is not told"
    turn.end()
    assert len(peers["b"].got()) == 1


def test_what_cannot_travel_or_has_no_way_is_told_to_the_publisher(sending, turn, peers):
    with pytest.raises(LocalProtocolError, match="set"):
        sending.send(packet(1, body={1}))
    with pytest.raises(PeerLostError, match="away"):
        sending.send(packet(2, "nobody/x"))
    turn.end()
    assert peers["b"].sent == []


@pytest.mark.parametrize("how", ["alone", "behind another", "to a slow peer"])
def test_a_packet_that_fits_no_frame_is_refused_though_others_like_it_went_before(sending, turn, peers, how):
    sending.send(packet(1))
    if how != "behind another":
        turn.end()
    peers["b"].congested = how == "to a slow peer"
    with pytest.raises(LocalProtocolError, match="a frame has room"):
        sending.send(packet(2, body="x" * MAX_MESSAGE_BYTES))
    sending.send(packet(3))
    turn.end()
    assert [it.seq for it in (*peers["b"].got(), *peers["b"].taken)] == [1, 3]


NO_NUMBER: Any = object()


@pytest.mark.parametrize(("body", "arrives"), [(Level(numpy.float64(0.5)), 0.5), (Level(NO_NUMBER), None)])
def test_a_body_that_does_not_keep_to_its_class_is_looked_at_though_others_like_it_went_before(
    sending, turn, peers, body, arrives
):
    sending.send(packet(1, kind="sending test level", body=Level(0.25)))
    if arrives is None:
        with pytest.raises(LocalProtocolError, match="level is of the type object"):
            sending.send(packet(2, kind="sending test level", body=body))
    else:
        sending.send(packet(2, kind="sending test level", body=body))
    turn.end()
    assert [it.body.level for it in peers["b"].got()] == [0.25, arrives][: 1 + (arrives is not None)]


def test_other_links_are_other_ways(sending, turn, peers):
    sending.send(packet(1))
    turn.end()
    newer = Peer()
    sending.change({"b": newer}, (newer,))
    sending.send(packet(2))
    turn.end()
    assert [it.seq for it in peers["b"].got()] == [1] and [it.seq for it in newer.got()] == [2]
    sending.change({}, ())
    with pytest.raises(PeerLostError):
        sending.send(packet(3))
    assert sending.send(packet(4, NEIGHBOURS)) == 0


def test_another_fence_is_another_way(sending, turn, peers):
    def under(epoch, seq):
        fence = Fence("a/T", (epoch, "a")) if epoch else None
        return replace(packet(seq), fence=fence)

    its = [under(1, 1), under(1, 2), under(2, 3), under(2, 4), under(0, 5), under(1, 6), under(1, 7)]
    for it in its:
        sending.send(it)
    turn.end()
    assert peers["b"].got() == its


def test_a_way_that_has_ended_keeps_no_session(sending, turn, peers):
    """A session that has ended may hold megabytes that wait."""
    sending.send(packet(1))
    sending.send(packet(2, NEIGHBOURS))
    turn.end()
    gone = weakref.ref(peers["b"])
    sending.change({}, ())
    peers.clear()
    gc.collect()
    assert gone() is None


def test_ways_are_forgotten_where_there_are_too_many(sending, turn, peers):
    sending.send(packet(0))
    for number in range(MOST_WAYS + 10):
        sending.send(packet(number, f"c/{number}"))
    sending.send(packet(1))
    turn.end()
    assert [it.seq for it in peers["b"].got()] == [0, 1]
    gc.collect()
    assert sum(isinstance(it, Way) for it in gc.get_objects()) <= MOST_WAYS


def test_no_way_is_made_of_links_that_are_being_replaced():
    """A thread that publishes finds the old link just before another thread takes it away."""
    peers, older, newer, turn = dict[str, Any](), Peer(), Peer(), Turn()
    sending = made(turn, peers)

    class Links(dict):
        """Lets the other thread begin while a sender looks for its way, and no sooner."""

        def get(self, name, default=None):
            other.start()
            return older

    other = threading.Thread(target=lambda: sending.change({"b": newer}, (newer,)))
    sending.change(Links(), ())
    sending.send(packet(1))
    other.join()
    sending.send(packet(2))
    turn.end()
    assert [it.seq for it in older.got()] == [1] and [it.seq for it in newer.got()] == [2]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["b/x", "b/y", "c/x", NEIGHBOURS]),
            st.integers(0, BATCH_BYTES // 2),
            st.booleans(),
            st.sampled_from(["", "", "", "turn ends", "other links", "b slow", "b quick"]),
        ),
        max_size=30,
    )
)
def test_in_whatever_way_a_packet_is_sent_it_arrives_once_and_in_order(its):
    """The frames are those that were announced (see `Peer`)."""
    turn, peers = Turn(), {"b": Peer(), "c": Peer()}
    sending = made(turn, peers)
    for seq, (to, size, retry, happens) in enumerate(its):
        it = packet(seq, to, body=bytes(size))
        sending.send(it, retry)
        if happens == "turn ends":
            turn.end()
        elif happens == "other links":
            sending.change(dict(peers), tuple(peers.values()))
        elif happens.startswith("b "):
            peers["b"].congested = happens == "b slow"
    turn.end()
    for name, peer in peers.items():
        wanted = [seq for seq, (to, _, _, _) in enumerate(its) if to == NEIGHBOURS or to.startswith(name)]
        sent, offered = [it.seq for it in peer.got()], [it.seq for it in peer.taken]
        assert sorted(sent + offered) == wanted and sent == sorted(sent) and offered == sorted(offered)
        assert peer.retries == sum(it[2] for seq, it in enumerate(its) if seq in wanted)


def test_what_is_published_while_waiting_packets_are_sent_follows_them() -> None:
    class Telling(Peer):
        """Has something told on `log` at the first packet, as a gate does that holds one back."""

        def offer(self, channel, key, message):
            super().offer(channel, key, message)
            if len(self.offered) == 1:
                sending.send(Packet("log", "words", "a/client/x", "b/log", 0.0, 9, "held back"))

    sought: list[str] = []

    def seek(agent: str) -> bool:
        sought.append(agent)
        return True

    sending = Sending(lambda packet: PeerLostError(""), lambda function: function(), seek)
    peer: Any = Telling()
    for number in range(2):
        assert sending.send(Packet("system", "words", "a/client/x", "b/client/y", 0.0, number, number)) == 1
    assert sought == ["b"], "a link is asked for once"
    sending.change({"b": peer}, (peer,))
    assert [packet.body for packet in peer.taken] == [0, 1, "held back"]
    assert sending.give_up("b") == 0
