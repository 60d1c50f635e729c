"""Nobody speaks for another, in a letter to a task neither."""

import pytest
from msgspec.structs import replace
from services.numbered import SINK, Numbered, Sink, numbers

from pancakes.mesh.migration.post import ForwardTo, Letter
from pancakes.mesh.wire.codec import Encoder
from pancakes.packet import Packet
from pancakes.testing import FleetInTest

COURIER = "a/kernel/Courier"
FORGED = Packet("system", "test.numbered", "c/client/Source", SINK, 0.0, 1, Numbered(1))


def letter(packet, sender):
    return Letter("a/Sink", "a stream", 1, 1, Encoder().packet(packet), sender)


@pytest.fixture
def fleet():
    with FleetInTest(seed=3) as made:
        made.start("a", tasks={"Sink": Sink})
        made.start("b")
        made.start("c")
        made.connect()
        yield made


@pytest.mark.parametrize(
    ("forged", "whose"),
    [
        (letter(FORGED, "c"), "c"),
        (letter(FORGED, "b"), "c/client/Source"),
        (letter(replace(FORGED, source="a/client/Source"), "b"), "a/client/Source"),
        (letter(replace(FORGED, source="b/client/Source"), "c"), "c"),
        (letter(replace(FORGED, source="b/client/Source"), "a"), "a"),
    ],
)
def test_a_letter_in_the_name_of_another_agent_is_refused_and_said(fleet, forged, whose):
    fleet.agents["b"].publish("network", forged, to=COURIER)
    fleet.run_for(1.0)
    assert numbers(fleet) == []
    refusal = f"a packet for a/Sink was refused: b speaks for {whose}"
    assert [line for line in fleet.agents["a"].lines("warning") if refusal in line]


def test_a_letter_of_its_own_is_taken(fleet):
    fleet.agents["b"].publish("network", letter(replace(FORGED, source="b/client/Source"), "b"), to=COURIER)
    fleet.run_for(1.0)
    assert numbers(fleet) == [1]


def test_an_agent_that_was_not_asked_does_not_get_the_letters_of_a_task(fleet):
    fleet.network.partition(["a"], ["b", "c"])
    fleet.agents["b"].publish("system", Numbered(1), to=SINK)
    fleet.run_for(0.1)
    stolen: list[Packet] = []
    fleet.agents["c"].kernel.stream.tap("network", stolen.append, ("post.letter",))
    fleet.agents["c"].publish("network", ForwardTo("a/Sink", "c", 9), to="b/kernel/Courier")
    fleet.run_for(0.1)
    assert stolen == [] and fleet.agents["b"].agent.outbox.waiting() == {"a/Sink": 1}
    fleet.network.heal()
    fleet.run_for(10.0)
    assert numbers(fleet) == [1]
