"""A hand-off is between two agents: what a third says of it, or says unasked, changes nothing."""

import pytest
from msgspec.structs import replace
from services.counting import Count

from pancakes.control import Migrate, Stop
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.messages import Commit, Nak, Piece, Transfer, addressed
from pancakes.mesh.migration.pieces import cut
from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.packet import Packet
from pancakes.testing import FleetInTest

COUNT = TaskId("a", "Count")


@pytest.fixture
def fleet():
    with FleetInTest(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": Count})
        made.start("b")
        made.start("c")
        made.connect()
        made.run_for(1.0)
        yield made


def say(fleet, speaker, message, to):
    journal = fleet.agents[to].agent.mesh.identity.journal
    fleet.agents[speaker].publish("network", addressed(message, journal), to=f"{to}/client")


def test_a_snapshot_that_no_place_was_promised_for_is_declined_and_leaves_nothing(fleet):
    answers = []
    fleet.agents["c"].kernel.stream.tap("network", lambda packet: answers.append(packet.body))
    for piece in cut(Transfer(TaskId("c", "Count"), Epoch(1, "c"), bytes(200_000))):
        say(fleet, "c", piece, "b")
    fleet.run_for(1.0)
    assert {type(answer) for answer in answers} == {Nak}
    assert {answer.reason for answer in answers} == {"was not asked for a place for it first"}
    assert fleet.agents["b"].agent.records.all() == {}


def test_a_third_that_asks_for_a_place_for_a_task_on_its_way_takes_it_from_none(fleet):
    """Whether it may have one or not: the task goes on, and arrives."""
    b = fleet.agents["b"]
    begun: list[Packet] = []
    b.kernel.stream.tap("network", begun.append, ("migration.reserve",))
    asked = fleet.agents["a"].publish("sysctrl", Migrate("Count", to="b"))
    assert fleet.run_until(lambda: begun)
    answers = []
    fleet.agents["c"].kernel.stream.tap("network", lambda packet: answers.append(packet.body))
    offer = Epoch(9, "c")
    good = replace(begun[0].body, offer=offer, journal="")
    for request in (good, replace(good, request=replace(good.request, type="nope"))):
        say(fleet, "c", request, "b")
    assert fleet.agents["a"].reply_to(asked).ok
    assert b.running() == ["Count"]
    assert [answer.reason for answer in answers if isinstance(answer, Nak)]


def test_of_made_up_tasks_nothing_is_kept(fleet):
    b = fleet.agents["b"]
    before = dict(b.component("client").places)
    for number in range(500):
        say(fleet, "c", Commit(TaskId("c", f"T{number}"), Epoch(1, "c")), "b")
    fleet.run_for(1.0)
    assert dict(b.component("client").places) == before


def test_the_service_of_a_task_on_its_way_is_not_stopped(fleet):
    """What it has said, and not heard, is in its mailbox alone."""
    a, b = fleet.agents["a"], fleet.agents["b"]
    a.publish("sysctrl", Migrate("Count", to="b"))

    def is_prepared():
        return COUNT in b.agent.records.all() and b.agent.records.all()[COUNT].phase is Phase.PREPARED

    assert fleet.run_until(is_prepared)
    fleet.network.partition(["a"])
    for agent in (a, b):
        reply = agent.ask(Stop("client", dry_run=True))
        assert reply.reason == f"{agent.name}/client must not stop while a/Count is being handed over"
    fleet.network.heal()
    assert fleet.run_until(lambda: all(agent.ask(Stop("client", dry_run=True)).ok for agent in (a, b)), 30.0)
    assert a.running() == ["Count"], "b never said that it has it"


def test_a_third_agent_neither_gives_a_task_away_nor_sends_its_snapshot(fleet):
    """b has the snapshot on disk, and a has not heard so."""
    a, b = fleet.agents["a"], fleet.agents["b"]
    taken = []
    b.kernel.stream.tap("network", lambda packet: taken.append(packet.body))
    a.publish("sysctrl", Migrate("Count", to="b"))

    def is_prepared():
        return COUNT in b.agent.records.all() and b.agent.records.all()[COUNT].phase is Phase.PREPARED

    assert fleet.run_until(is_prepared)
    fleet.network.partition(["a"])
    record = b.agent.records.all()[COUNT]
    say(fleet, "c", Commit(COUNT, record.offer), "b")
    for piece in [body for body in taken if isinstance(body, Piece)]:
        later = Epoch(piece.offer.n + 1, piece.offer.minter)
        say(fleet, "c", replace(piece, offer=later, journal=""), "b")
    fleet.run_for(1.0)
    assert b.agent.records.all()[COUNT] == record
    assert b.running() == []
