"""A hand-off is between two agents: what a third says of it, or says unasked, changes nothing."""

import pytest
from msgspec.structs import replace
from services.counting import Count

from pancakes.control import Checkpoints, Forget, Migrate, Stop
from pancakes.durable.arrivals import MOST_IN_DOUBT
from pancakes.durable.host_state import MOST_SLOTS
from pancakes.durable.messages import Bid, Commit, Nak, Piece, Reserve, Reserved, Solicit, Transfer, addressed
from pancakes.durable.record import Epoch, Phase, TaskId
from pancakes.durable.snapshot import Snapshot, cut
from pancakes.packet import Packet
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": Count})
        made.start("b")
        made.start("c")
        made.connect()
        made.run_for(1.0)
        yield made


def say(fleet, speaker, message, to, at="client"):
    journal = fleet.agents[to].agent.mesh.identity.journal
    fleet.agents[speaker].publish("network", addressed(message, journal), to=f"{to}/{at}")


def answers_to(fleet, name):
    """Returns what an agent is told from now on of hand-offs; the list grows."""
    told = []
    fleet.agents[name].kernel.stream.tap("network", lambda packet: told.append(packet.body))
    return told


def place_for(fleet, name, of=None):
    """Returns how c asks for a place for a task that was born there; `of`: the task that it describes."""
    version = fleet.agents["a"].slot("Count").spec.version
    offer = Epoch(1, "c")
    return Reserve(TaskId("c", name), offer, Solicit(TaskId("c", of or name), 1, "test.Count", version, "client"))


def test_a_snapshot_that_no_place_was_promised_for_is_declined_and_leaves_nothing(fleet):
    answers = []
    fleet.agents["c"].kernel.stream.tap("network", lambda packet: answers.append(packet.body))
    for piece in cut(Transfer(TaskId("c", "Count"), Epoch(1, "c"), bytes(200_000))):
        say(fleet, "c", piece, "b")
    fleet.run_for(1.0)
    assert {type(answer) for answer in answers} == {Nak}
    assert {answer.refusal.text for answer in answers} == {"was not asked for a place for it first"}
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
    assert [answer.refusal.text for answer in answers if isinstance(answer, Nak)]


@pytest.mark.parametrize("moved", [False, True], ids=["from its birthplace", "from where it has moved"])
def test_task_is_taken_only_from_an_agent_that_has_it(fleet, moved):
    """C has the code of the task, makes up an epoch, a snapshot and the rest, and gives what it never had."""
    owner = "a"
    if moved:
        fleet.start("d")
        fleet.connect()
        assert fleet.agents["a"].ask(Migrate("Count", to="d")).ok
        owner = "d"
    answers = answers_to(fleet, "c")
    request = Solicit(COUNT, 1, "test.Count", place_for(fleet, "Count").request.version, "client")
    say(fleet, "c", Reserve(COUNT, Epoch(9, "c"), request), "b")
    fleet.run_for(1.0)
    (refused,) = [answer for answer in answers if isinstance(answer, Nak | Reserved)]
    assert isinstance(refused, Nak) and refused.refusal.text.startswith(f"{owner} has a/Count, under the epoch ")
    assert "c has no right to it" in refused.refusal.text
    assert fleet.agents[owner].running() == ["Count"]


@pytest.mark.parametrize("lost", ["a", "d", "ad"])
def test_task_goes_on_from_agents_that_are_gone(fleet, lost):
    """It was born on a, went to d, and is on c: whom b would ask is not there, and that is no reason to refuse."""
    fleet.start("d")
    fleet.connect()
    assert fleet.agents["a"].ask(Migrate("Count", to="d")).ok
    assert fleet.agents["d"].ask(Migrate("Count", to="c")).ok
    for name in lost:
        fleet.crash(name)
    fleet.run_for(3.0)
    assert fleet.agents["c"].ask(Migrate("Count", to="b")).ok
    assert fleet.agents["b"].running() == ["Count"]


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


def test_a_request_for_a_place_is_about_one_task(fleet):
    answers = answers_to(fleet, "c")
    say(fleet, "c", place_for(fleet, "T1", of="T2"), "b")
    fleet.run_for(1.0)
    assert [answer.refusal.text for answer in answers] == ["was asked for a place for c/T1 and told of c/T2"]


def test_an_agent_keeps_so_many_places_for_a_peer(fleet):
    answers = answers_to(fleet, "c")
    for number in range(MOST_SLOTS + 1):
        say(fleet, "c", place_for(fleet, f"T{number}"), "b")
    fleet.run_for(1.0)
    assert [type(answer) for answer in answers].count(Reserved) == MOST_SLOTS
    refusal = answers[-1].refusal
    assert (refusal.code, refusal.text) == ("busy", "keeps 64 places for tasks of c already")
    assert refusal.retry_after_s > 0


def bring(fleet, name):
    """C brings a task to b, and never gives it away."""
    asked = place_for(fleet, name)
    say(fleet, "c", asked, "b")
    fleet.run_for(0.1)
    snapshot = Snapshot(asked.task_id, "test.Count", asked.request.version, "client")
    for piece in cut(Transfer(asked.task_id, asked.offer, snapshot.encode())):
        say(fleet, "c", piece, "b")
    fleet.run_for(0.1)


def kept(fleet):
    return [it.task_id.name for it in fleet.agents["b"].agent.records.all().values() if it.phase is Phase.PREPARED]


def test_what_a_peer_brings_and_never_gives_away_is_bounded(fleet):
    answers = answers_to(fleet, "c")
    for number in range(MOST_IN_DOUBT + 3):
        bring(fleet, f"T{number}")
    assert len(kept(fleet)) == MOST_IN_DOUBT
    reasons = [answer.refusal.text for answer in answers if isinstance(answer, Nak)]
    assert reasons and "keeps 64 tasks that c has brought and not handed over" in reasons[0]
    assert fleet.agents["a"].ask(Migrate("Count", to="b")).ok, "that of others has its place"


def test_what_a_lost_peer_has_brought_can_be_dropped(fleet):
    b = fleet.agents["b"]
    bring(fleet, "T1")
    assert "c is connected" in b.ask(Forget("T1", force=True)).reason
    (row,) = b.ask(Checkpoints("")).result
    assert (row["task_id"], row["held"], row["peer"]) == ("c/T1", "in doubt", "c")
    fleet.crash("c")
    fleet.run_for(3.0)
    assert "Forgotten by force, it is nowhere if c has given it away" in b.ask(Forget("T1")).reason
    assert kept(fleet) == ["T1"]
    assert b.ask(Forget("T1", force=True)).ok
    assert kept(fleet) == [] and b.ask(Checkpoints("")).result == []


def test_a_snapshot_of_another_task_than_a_place_was_promised_for_is_declined(fleet):
    answers = answers_to(fleet, "c")
    asked = place_for(fleet, "T1")
    say(fleet, "c", asked, "b")
    fleet.run_for(1.0)
    other = Snapshot(TaskId("c", "T2"), "test.Count", asked.request.version, "client").encode()
    for piece in cut(Transfer(asked.task_id, asked.offer, other)):
        say(fleet, "c", piece, "b")
    fleet.run_for(1.0)
    assert [type(answer) for answer in answers] == [Reserved, Nak]
    assert answers[-1].refusal.text == "the snapshot is of c/T2, not of c/T1"
    assert fleet.agents["b"].agent.records.all() == {}


@pytest.mark.parametrize("at", ["client", "network/TaskMigrator"])
def test_what_was_meant_for_an_agent_with_another_disk_is_not_answered(fleet, at):
    answers, asked = answers_to(fleet, "c"), place_for(fleet, "T1")
    message = asked if at == "client" else asked.request
    fleet.agents["c"].publish("network", addressed(message, "another"), to=f"b/{at}")
    fleet.run_for(1.0)
    assert answers == []
    say(fleet, "c", message, "b", at)
    fleet.run_for(1.0)
    assert len(answers) == 1


def test_a_bid_for_a_former_question_does_not_count(fleet):
    """What c says of the former one is there before its own answer."""
    a, c = fleet.agents["a"], fleet.agents["c"]
    assert a.ask(Migrate("Count", dry_run=True)).result["winner"] == "b", "of equal costs the lower name's"

    def bid_for_the_former(packet):
        former = Bid(packet.body.task_id, packet.body.ask - 1, -100.0, {"tasks: active tasks": -100.0})
        say(fleet, "c", former, "a", "network/TaskMigrator")

    c.kernel.stream.tap("network", bid_for_the_former, ("migration.solicit",))
    reply = a.ask(Migrate("Count", dry_run=True))
    assert reply.result["winner"] == "b"
    assert {line["peer"]: line["cost"] for line in reply.result["lines"]} == {"b": 0.0, "c": 0.0}
