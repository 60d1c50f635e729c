"""What leaves an agent: the way of packets of one source, channel, class and destination is found once.

However often something changes, nobody may notice that it was known.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from pancakes.errors import LocalProtocolError, MailboxFull, UnknownChannel
from pancakes.kernel.component import Component
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual import VirtualDispatcher
from pancakes.packet import Packet, packet_type


@packet_type("test_exits.number")
@dataclass(frozen=True)
class Number:
    """A packet of these tests."""

    n: int


@packet_type("test_exits.word")
@dataclass(frozen=True)
class Word:
    """Another."""

    text: str = ""


class Gateway:
    """Takes what leaves, and says which packets have come by a way that was known."""

    def __init__(self) -> None:
        self.taken: list[Packet] = []
        self.known: list[Packet] = []
        self.ways: list[Way] = []
        self.error: Exception | None = None

    def __call__(self, packet: Packet) -> Way:
        if self.error is not None:
            raise self.error
        self.taken.append(packet)
        self.ways.append(Way(self))
        return self.ways[-1]

    def end_ways(self) -> None:
        for way in self.ways:
            way.is_open = False


class Way:
    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        self.is_open = True

    def __call__(self, packet: Packet) -> int | None:
        if not self.is_open:
            return None
        if self.gateway.error is not None:
            raise self.gateway.error
        self.gateway.taken.append(packet)
        self.gateway.known.append(packet)
        return 1


class Rig:
    """A kernel in virtual time with a source of packets and a gateway."""

    def __init__(self) -> None:
        self.dispatcher = VirtualDispatcher(1)
        self.kernel = Kernel("a", virtual=self.dispatcher)
        self.stream = self.kernel.stream
        self.source = self.kernel.spawn(Component, "a/client/Source")
        self.dispatcher.settle()
        self.stream.gateway = self.gateway = Gateway()


@pytest.fixture
def rig():
    return Rig()


def test_only_the_first_packet_has_to_look_for_its_way(rig):
    for n in range(3):
        rig.source.publish("system", Number(n), "b/client/T")
    assert [packet.body.n for packet in rig.gateway.taken] == [0, 1, 2]
    assert [packet.body.n for packet in rig.gateway.known] == [1, 2]
    assert len({packet.seq for packet in rig.gateway.taken}) == 3
    first, second = rig.gateway.taken[:2]
    assert (first.channel, first.type, first.source, first.destination) == (
        second.channel,
        second.type,
        second.source,
        second.destination,
    )


def test_another_source_channel_class_or_destination_has_a_way_of_its_own(rig):
    other = rig.kernel.spawn(Component, "a/client/Other")
    rig.source.publish("system", Number(0), "b")
    rig.source.publish("system", Number(1), "c")
    rig.source.publish("ctrl", Number(2), "b")
    rig.source.publish("system", Word(), "b")
    other.publish("system", Number(3), "b")
    assert len(rig.gateway.taken) == 5 and not rig.gateway.known


def test_where_a_way_has_ended_another_is_looked_for(rig):
    rig.source.publish("system", Number(0), "b")
    rig.gateway.end_ways()
    for n in (1, 2):
        rig.source.publish("system", Number(n), "b")
    assert [packet.body.n for packet in rig.gateway.taken] == [0, 1, 2], "each of them once"
    assert [packet.body.n for packet in rig.gateway.known] == [2]


@pytest.mark.parametrize("successor", [None, Gateway()])
def test_another_gateway_gets_all_that_comes_after(rig, successor):
    rig.source.publish("system", Number(0), "b")
    rig.stream.gateway = successor
    rig.source.publish("system", Number(1), "b")
    assert len(rig.gateway.taken) == 1
    assert rig.stream.undelivered == (successor is None)
    if successor is not None:
        assert len(successor.taken) == 1


def test_who_sees_what_leaves_sees_all_of_it_from_then_on_and_until_he_ends_it(rig):
    seen = []
    rig.source.publish("system", Number(0), "b")
    rig.stream.tap_outgoing(seen.append)
    for n in (1, 2, 3):
        rig.source.publish("system", Number(n), "b")
    rig.stream.untap_outgoing(seen.append)
    rig.source.publish("system", Number(4), "b")
    assert [packet.body.n for packet in seen] == [1, 2, 3]
    assert len(rig.gateway.taken) == 5


@pytest.mark.parametrize("error", [MailboxFull("it is slow"), LocalProtocolError("too large")])
def test_who_may_not_send_hears_it_and_nobody_sees_the_packet(rig, error):
    seen = []
    rig.stream.tap_outgoing(seen.append)
    rig.source.publish("system", Number(0), "b")
    rig.gateway.error = error
    with pytest.raises(type(error)):
        rig.source.publish("system", Number(1), "b")
    rig.gateway.error = None
    rig.source.publish("system", Number(2), "b")
    assert [packet.body.n for packet in seen] == [packet.body.n for packet in rig.gateway.taken] == [0, 2]


def test_on_a_channel_that_has_gone_nothing_leaves(rig):
    rig.stream.open("map")
    rig.source.publish("map", Number(0), "b")
    rig.stream.close("map")
    with pytest.raises(UnknownChannel, match="no such channel"):
        rig.source.publish("map", Number(1), "b")
    rig.stream.open("map")
    rig.source.publish("map", Number(2), "b")
    assert [packet.body.n for packet in rig.gateway.taken] == [0, 2]


def test_a_stream_that_is_silenced_lets_nothing_out(rig):
    rig.source.publish("system", Number(0), "b")
    rig.stream.silence()
    rig.source.publish("system", Number(1), "b")
    assert len(rig.gateway.taken) == 1 and rig.stream.undelivered == 1


def test_what_changes_while_a_way_is_looked_for_is_not_overlooked(rig):
    """The gateway is closed, or a recorder begins, while the first packet is being sent."""
    seen = []

    def begins(packet):
        if not rig.gateway.taken:
            rig.stream.tap_outgoing(seen.append)
        return rig.gateway(packet)

    rig.stream.gateway = begins
    rig.source.publish("system", Number(0), "b")
    rig.source.publish("system", Number(1), "b")
    assert [packet.body.n for packet in seen] == [1]

    def closes(packet):
        rig.stream.gateway = None
        return rig.gateway(packet)

    rig.stream.gateway = closes
    rig.source.publish("system", Number(2), "b")
    rig.source.publish("system", Number(3), "b")
    assert [packet.body.n for packet in rig.gateway.taken] == [0, 1, 2]


class ExitModel(RuleBasedStateMachine):
    """Packets leave while all that they depend on changes; a model without a memory says what must come of each."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig()
        self.seen: list[int] = []
        self.tap = lambda packet: self.seen.append(packet.body.n)
        self.is_tapped = False
        self.open = {"system", "map"}
        self.rig.stream.open("map")
        self.is_shut = False
        self.n = 0

    @rule()
    def end_ways(self):
        self.rig.gateway.end_ways()

    @rule(shut=st.booleans())
    def shut_gateway(self, shut):
        self.is_shut = shut
        self.rig.stream.gateway = None if shut else self.rig.gateway

    @rule(tapped=st.booleans())
    def tap_or_not(self, tapped):
        if tapped and not self.is_tapped:
            self.rig.stream.tap_outgoing(self.tap)
        elif not tapped:
            self.rig.stream.untap_outgoing(self.tap)
        self.is_tapped = tapped

    @rule(is_open=st.booleans())
    def channel(self, is_open):
        if is_open:
            self.rig.stream.open("map")
            self.open.add("map")
        elif "map" in self.open:
            self.rig.stream.close("map")
            self.open.discard("map")

    @rule(full=st.booleans())
    def slow(self, full):
        self.rig.gateway.error = MailboxFull("it is slow") if full else None

    @rule(channel=st.sampled_from(["system", "map"]), to=st.sampled_from(["b", "*"]))
    def publish(self, channel, to):
        self.n += 1
        self.seen.clear()
        taken, lost = len(self.rig.gateway.taken), self.rig.stream.undelivered
        if channel not in self.open:
            expected: type[Exception] | None = UnknownChannel
        else:
            expected = MailboxFull if self.rig.gateway.error is not None and not self.is_shut else None
        if expected is not None:
            with pytest.raises(expected):
                self.rig.source.publish(channel, Number(self.n), to)
        else:
            self.rig.source.publish(channel, Number(self.n), to)
        goes = expected is None and not self.is_shut
        assert [packet.body.n for packet in self.rig.gateway.taken[taken:]] == ([self.n] if goes else [])
        assert self.rig.stream.undelivered - lost == (expected is None and self.is_shut)
        assert self.seen == ([self.n] if expected is None and self.is_tapped else [])


ExitModel.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
test_whatever_changes_each_packet_goes_where_it_would_without_a_memory = ExitModel.TestCase
