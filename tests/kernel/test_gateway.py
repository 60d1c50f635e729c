"""What leaves an agent: each packet goes through the gateway, and a tap sees it only where it was sent."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pancakes.errors import LocalProtocolError, MailboxFullError, UnknownChannelError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.packet import Packet, packet_type


@packet_type("test_gateway.number")
@dataclass(frozen=True)
class Number:
    """A packet of these tests."""

    n: int


class Rig:
    """A kernel in virtual time with a source of packets and a gateway.

    Attributes:
        taken: the numbers of the packets that the gateway has taken.
        error: what the gateway raises instead of taking a packet.
    """

    def __init__(self) -> None:
        self.dispatcher = VirtualDispatcher(1)
        self.kernel = Kernel("a", virtual=self.dispatcher)
        self.stream = self.kernel.stream
        self.source = self.kernel.spawn(ActorCore, "a/client/Source")
        self.dispatcher.settle()
        self.taken: list[int] = []
        self.error: Exception | None = None
        self.stream.gateway = self.take

    def take(self, packet: Packet) -> None:
        if self.error is not None:
            raise self.error
        self.taken.append(packet.body.n)

    def publish(self, n: int, channel: str = "system", to: str = "b") -> None:
        self.source.publish(channel, Number(n), to)


@pytest.fixture
def rig():
    return Rig()


def test_what_is_for_an_agent_elsewhere_or_for_all_neighbours_leaves(rig):
    for n, to in enumerate(["b", "b/client/T", "*", "", "a/client/T", "a"]):
        rig.publish(n, to=to)
    assert rig.taken == [0, 1, 2]


def test_what_is_for_a_task_goes_to_the_courier(rig):
    carried = []
    rig.stream.courier = lambda packet: carried.append(packet.body.n)
    rig.publish(1, to="task:b/T")
    assert (carried, rig.taken) == ([1], [])


def test_without_a_gateway_what_would_leave_is_counted(rig):
    rig.publish(0)
    rig.stream.gateway = None
    rig.publish(1)
    assert rig.taken == [0] and rig.stream.undelivered == 1


def test_a_tap_sees_what_leaves_from_then_on_until_it_is_removed(rig):
    seen: list[Packet] = []
    rig.publish(0)
    rig.stream.tap_outgoing(seen.append)
    for n in (1, 2):
        rig.publish(n)
    rig.stream.untap_outgoing(seen.append)
    rig.publish(3)
    assert [packet.body.n for packet in seen] == [1, 2]
    assert rig.taken == [0, 1, 2, 3]


@pytest.mark.parametrize("error", [MailboxFullError("it is slow"), LocalProtocolError("too large")])
def test_a_publisher_that_may_not_send_is_told_so_and_no_tap_sees_the_packet(rig, error):
    seen: list[Packet] = []
    rig.stream.tap_outgoing(seen.append)
    rig.error = error
    with pytest.raises(type(error)):
        rig.publish(0)
    rig.error = None
    rig.publish(1)
    assert [packet.body.n for packet in seen] == rig.taken == [1]


def test_on_a_channel_that_was_closed_nothing_leaves(rig):
    rig.stream.open("map")
    rig.publish(0, "map")
    rig.stream.close("map")
    with pytest.raises(UnknownChannelError, match="no such channel"):
        rig.publish(1, "map")
    rig.stream.open("map")
    rig.publish(2, "map")
    assert rig.taken == [0, 2]


def test_a_stream_that_is_silenced_lets_nothing_out(rig):
    seen: list[Packet] = []
    rig.stream.tap_outgoing(seen.append)
    rig.stream.silence()
    rig.publish(0)
    assert rig.taken == [] and seen == [] and rig.stream.undelivered == 1
