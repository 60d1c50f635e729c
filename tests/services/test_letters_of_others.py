"""No agent speaks for another, and none can take the effect of another's letters to a task away."""

import pytest
from msgspec.structs import replace
from services.numbered import SINK, Numbered, Sink, numbers

from pancakes.durable.delivery import ForwardTo, Letter, Receipt
from pancakes.mesh.codec import encode_packet
from pancakes.packet import Packet
from pancakes.testing import Fleet

COURIER = "a/kernel/Courier"
FORGED = Packet("system", "test.numbered", "c/client/Source", SINK, 0.0, 1, Numbered(1))


def letter(packet, sender):
    return Letter("a/Sink", "a stream", 1, 1, encode_packet(packet), sender)


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
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


def stream_of(fleet, agent):
    """A stream of an agent, as another can know it: from the agent's hello, and by its habit of numbering."""
    return [fleet.agents[agent].agent.outbox.name + ending for ending in ("", "#", "/1", "/1#")]


def test_letters_in_another_agents_stream_take_no_effect_away(fleet):
    """C jumps far ahead in the stream of B: what B sends is then old, acknowledged, and without effect."""
    packet = encode_packet(replace(FORGED, source="c/client/Source"))
    for stream in stream_of(fleet, "b"):
        fleet.agents["c"].publish("network", Letter("a/Sink", stream, 1000, 1000, packet, "c"), to=COURIER)
    fleet.run_for(0.1)
    for n in (1, 2, 3):
        fleet.agents["b"].publish("system", Numbered(n), to=SINK)
    fleet.run_for(1.0)
    assert numbers(fleet)[-3:] == [1, 2, 3]


def test_receipts_of_an_agent_without_the_task_acknowledge_nothing(fleet):
    fleet.network.partition(["a"], ["b", "c"])
    fleet.agents["b"].publish("system", Numbered(1), to=SINK)
    fleet.run_for(0.1)
    for stream in stream_of(fleet, "b"):
        fleet.agents["c"].publish("network", Receipt("a/Sink", stream, 1000, 1000), to="b/kernel/Courier")
    fleet.run_for(0.1)
    assert fleet.agents["b"].agent.outbox.waiting() == {"a/Sink": 1}


def test_agents_that_are_asked_where_a_task_is_get_no_letter(fleet):
    """Whoever saw one could write in its stream; and what is in it is for the task only."""
    seen: list[Packet] = []
    fleet.agents["c"].kernel.stream.tap("network", seen.append, ("post.letter", "task.who_has"))
    fleet.crash("a")
    fleet.agents["b"].publish("system", Numbered(1), to=SINK)
    fleet.run_for(20.0)
    assert {packet.type for packet in seen} == {"task.who_has"}
    fleet.restart("a")
    fleet.run_for(10.0)
    assert numbers(fleet) == [1]
