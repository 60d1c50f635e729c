"""The Network Client takes what leaves: also where its way was known, and agents have gone and come since."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import pytest

from pancakes.control import Configure, Start, Stop
from pancakes.devices import Pose
from pancakes.packet import SYSTEM, packet_type
from pancakes.testing import Fleet


@pytest.fixture
def fleet():
    with Fleet(5) as made:
        made.start("a")
        made.start("b")
        made.connect()
        yield made


def say(fleet, number):
    """Publishes on `a`, for `b`; returns what has come there so far."""
    fleet.agents["a"].publish(SYSTEM, Pose(float(number), 0.0, 0.0), to="b")
    fleet.run_for(0.1)
    return [packet.body.x_m for packet in fleet.agents["b"].probe.packets(Pose)]


def test_what_is_for_an_agent_that_has_gone_is_counted_and_the_next_life_gets_what_follows(fleet):
    stream = fleet.agents["a"].kernel.stream
    assert say(fleet, 1) == [1.0] and say(fleet, 2) == [1.0, 2.0]
    fleet.stop("b")
    assert fleet.run_until(lambda: not fleet.agents["a"].agent.mesh.connected())
    before = stream.undelivered
    fleet.agents["a"].publish(SYSTEM, Pose(3.0, 0.0, 0.0), to="b")
    fleet.agents["a"].publish(SYSTEM, Pose(4.0, 0.0, 0.0), to="b")
    assert stream.undelivered == before + 2
    fleet.restart("b")
    fleet.connect()
    assert say(fleet, 5) == [5.0] and say(fleet, 6) == [5.0, 6.0]


def test_while_it_is_stopped_nothing_leaves(fleet):
    a = fleet.agents["a"]
    assert say(fleet, 1) == [1.0] and say(fleet, 2) == [1.0, 2.0]
    assert a.ask(Stop("network/NetworkClient")).ok
    before = a.kernel.stream.undelivered
    assert say(fleet, 3) == [1.0, 2.0] and a.kernel.stream.undelivered == before + 1
    assert a.ask(Start("network/NetworkClient")).ok
    assert say(fleet, 4) == [1.0, 2.0, 4.0]


@packet_type("network client test level")
class Level(msgspec.Struct, frozen=True):
    """A number that may not be negative, which a publisher is not asked about."""

    value: Annotated[int, msgspec.Meta(ge=0)]


def test_what_does_not_fit_its_type_is_dropped_counted_and_told_and_the_link_stays(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    before = b.kernel.stream.undelivered
    for value in (1, -1, 2):
        a.publish(SYSTEM, Level(value), to="b")
    fleet.run_for(0.1)
    assert [packet.body.value for packet in b.probe.packets(Level)] == [1, 2]
    assert b.kernel.stream.undelivered == before + 1
    (line,) = [line for line in b.lines("warning") if "level" in line]
    assert "a packet of a was dropped" in line and ">= 0" in line and "(from a/test/Probe)" in line
    assert not b.events("peer_down")


def test_a_command_that_does_not_fit_its_type_is_refused_with_the_reason(fleet):
    no_settings: Any = ["rate", 3]
    reply = fleet.agents["a"].ask(Configure("network/Discovery", no_settings), to="b")
    assert not reply.ok and "the type 'configure' has a bad body" in reply.reason and "$.settings" in reply.reason
