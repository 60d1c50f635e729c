"""A hand-off is between two agents: what a third says of it, or says unasked, changes nothing."""

import pytest
from msgspec.structs import replace
from services.counting import Count
from services.strangers import ask_for_room, heard_by, identity, offer, owns, room, say, tell

from pancakes.control import Checkpoints, Forget, Migrate, Stop
from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.durable.messages import Accept, Bid, Fact, Promise, Refuse, addressed
from pancakes.durable.quotas import MOST_OFFERED
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register, Standing
from pancakes.durable.snapshot import cut
from pancakes.packet import Packet
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")
SOLICIT = "migration.solicit"


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": Count})
        made.start("b")
        made.start("c")
        made.connect()
        made.run_for(1.0)
        yield made


def is_heir(fleet, name="b"):
    record = fleet.agents[name].agent.records.get(COUNT)
    return record is not None and record.standing is Standing.HEIR


def test_a_state_for_which_no_room_was_asked_is_declined_and_leaves_nothing(fleet):
    answers, task_id = heard_by(fleet, "c", Refuse), TaskId("c", "Count")
    offered = offer(fleet, "c", task_id, "b")
    say(fleet, "c", offered, "b")
    later = offered.register._replace(no=2)
    say(fleet, "c", Accept(task_id, "test.Count", "client", later, to=later.heir), "b")
    for piece in cut(task_id, later.stamp, bytes(200_000)):
        say(fleet, "c", piece, "b")
    fleet.run_for(1.0)
    texts = {answer.refusal.text for answer in answers}
    assert texts == {"was not asked for room for it first"} and len(answers) == 2
    assert fleet.agents["b"].agent.records.all() == {}


def test_a_third_that_asks_for_room_for_a_task_on_its_way_takes_it_from_none(fleet):
    """Whether it may have it or not: the task goes on, and arrives."""
    b = fleet.agents["b"]
    begun: list[Packet] = []
    b.kernel.stream.tap("network", lambda packet: begun.append(packet) if packet.body.hold else None, (SOLICIT,))
    asked = fleet.agents["a"].publish("sysctrl", Migrate("Count", to="b"))
    assert fleet.run_until(lambda: begun)
    answers = heard_by(fleet, "c", Refuse)
    for request in (room(fleet, COUNT), room(fleet, COUNT, "nope")):
        ask_for_room(fleet, "c", request, "b")
    assert fleet.agents["a"].reply_to(asked).ok
    assert b.running() == ["Count"]
    assert [answer.refusal.text for answer in answers]


@pytest.mark.parametrize("moved", [False, True], ids=["from its birthplace", "from where it has moved"])
def test_task_is_taken_only_from_an_agent_that_has_it(fleet, moved):
    """C has the code of the task, makes up an epoch, a state and the rest, and gives what it never had."""
    owner = "a"
    request = room(fleet, COUNT)
    if moved:
        fleet.start("d")
        fleet.connect()
        assert fleet.agents["a"].ask(Migrate("Count", to="d")).ok
        owner = "d"
    answers = heard_by(fleet, "c", Bid, Refuse)
    ask_for_room(fleet, "c", request, "b")
    fleet.run_for(1.0)
    (refused,) = answers
    assert isinstance(refused, Refuse) and refused.refusal.text.startswith(f"{owner} has a/Count, under the epoch ")
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
    b, c = fleet.agents["b"], identity(fleet, "c")
    before = dict(b.component("client").places)
    for number in range(500):
        task_id = TaskId("c", f"T{number}")
        say(fleet, "c", Promise(task_id, Epoch(1, identity(fleet, "b")), c, Register(Epoch(0, c))), "b")
        tell(fleet, "c", "b", owns(fleet, "c", task_id))
    fleet.run_for(1.0)
    assert dict(b.component("client").places) == before and b.agent.records.all() == {}
    assert list(b.component("kernel/Registrar").entries) == []


def test_the_service_of_a_task_on_its_way_is_not_stopped(fleet):
    """What it has said, and not heard, is in its mailbox alone."""
    a, b = fleet.agents["a"], fleet.agents["b"]
    a.publish("sysctrl", Migrate("Count", to="b"))

    assert fleet.run_until(lambda: is_heir(fleet))
    fleet.network.partition(["a"])
    for agent in (a, b):
        reply = agent.ask(Stop("client", dry_run=True))
        assert reply.reason == f"{agent.name}/client must not stop while a/Count is being handed over"
    fleet.network.heal()
    assert fleet.run_until(lambda: all(agent.ask(Stop("client", dry_run=True)).ok for agent in (a, b)), 30.0)
    assert a.running() == ["Count"], "b never said that it has it"


def test_a_third_agent_neither_gives_a_task_away_nor_sends_its_state(fleet):
    """B has the state on disk, and a has not heard so."""
    a, b, c = fleet.agents["a"], fleet.agents["b"], identity(fleet, "c")
    a.publish("sysctrl", Migrate("Count", to="b"))
    assert fleet.run_until(lambda: is_heir(fleet))
    fleet.network.partition(["a"])
    record = b.agent.records.all()[COUNT]
    taking = b.component("kernel/Registrar").entries[COUNT].memory.taking
    say(fleet, "c", Promise(COUNT, taking, c, record.register.summary(), record.snapshot), "b")
    say(fleet, "c", Promise(COUNT, taking, record.register.owner, record.register.summary(), record.snapshot), "b")
    say(fleet, "c", offer(fleet, "c", COUNT, "b", n=1), "b")
    later = record.register.summary()._replace(no=record.register.no + 1, heir=Identity(""))
    tell(fleet, "c", "b", Fact(COUNT, later))
    fleet.run_for(1.0)
    assert b.agent.records.all()[COUNT] == record
    assert b.running() == []


def bring(fleet, name):
    """C brings a task to b, and never gives it away."""
    task_id, request = TaskId("c", name), room(fleet, TaskId("c", name))
    ask_for_room(fleet, "c", request, "b")
    fleet.run_for(0.1)
    say(fleet, "c", offer(fleet, "c", task_id, "b", version=request.version), "b")
    fleet.run_for(0.1)


def kept(fleet):
    return [it.task_id.name for it in fleet.agents["b"].agent.records.all().values() if it.standing is Standing.HEIR]


def test_what_a_peer_brings_and_never_gives_away_is_bounded(fleet):
    answers = heard_by(fleet, "c", Refuse)
    for number in range(MOST_OFFERED + 3):
        bring(fleet, f"T{number}")
    assert len(kept(fleet)) == MOST_OFFERED
    reasons = [answer.refusal.text for answer in answers]
    assert reasons and "keeps 64 tasks that c has brought and not handed over" in reasons[0]
    assert fleet.agents["a"].ask(Migrate("Count", to="b")).ok, "that of others has its place"


def test_what_a_lost_peer_has_brought_can_be_dropped(fleet):
    b = fleet.agents["b"]
    bring(fleet, "T1")
    assert "c is connected" in b.ask(Forget("T1")).reason
    (row,) = b.ask(Checkpoints("")).result
    assert (row["task_id"], row["held"], row["peer"]) == ("c/T1", "in doubt", "c")
    fleet.crash("c")
    fleet.run_for(3.0)
    assert b.ask(Forget("T1", dry_run=True)).ok
    assert kept(fleet) == ["T1"]
    assert b.ask(Forget("T1")).ok
    assert kept(fleet) == [] and b.ask(Checkpoints("")).result == []


def test_a_state_of_another_task_than_room_was_kept_for_is_declined(fleet):
    answers, task_id = heard_by(fleet, "c", Bid, Refuse), TaskId("c", "T1")
    request = room(fleet, task_id)
    ask_for_room(fleet, "c", request, "b")
    fleet.run_for(1.0)
    other = offer(fleet, "c", TaskId("c", "T2"), "b", version=request.version).state
    wrong = offer(fleet, "c", task_id, "b")
    say(fleet, "c", Accept(task_id, "test.Count", "client", wrong.register, to=wrong.to, state=other), "b")
    fleet.run_for(1.0)
    assert [type(answer) for answer in answers] == [Bid, Refuse]
    assert answers[-1].refusal.text == "the snapshot is of c/T2, not of c/T1"
    assert fleet.agents["b"].agent.records.all() == {}


@pytest.mark.parametrize("hold", [False, True])
def test_what_was_meant_for_an_agent_with_another_disk_is_not_answered(fleet, hold):
    answers, request = heard_by(fleet, "c", Bid, Refuse), replace(room(fleet, TaskId("c", "T1")), hold=hold)
    fleet.agents["c"].publish("network", addressed(request, "another"), to=f"b/{MIGRATOR}")
    fleet.run_for(1.0)
    assert answers == []
    ask_for_room(fleet, "c", request, "b")
    fleet.run_for(1.0)
    assert len(answers) == 1


def test_a_bid_for_a_former_question_does_not_count(fleet):
    """What c says of the former one is there before its own answer."""
    a, c = fleet.agents["a"], fleet.agents["c"]
    assert a.ask(Migrate("Count", dry_run=True)).result["winner"] == "b", "of equal costs the lower name's"

    def bid_for_the_former(packet):
        former = Bid(packet.body.task_id, packet.body.ask - 1, -100.0, {"tasks: active tasks": -100.0})
        say(fleet, "c", former, "a", MIGRATOR)

    c.kernel.stream.tap("network", bid_for_the_former, ("migration.solicit",))
    reply = a.ask(Migrate("Count", dry_run=True))
    assert reply.result["winner"] == "b"
    assert {line["peer"]: line["cost"] for line in reply.result["lines"]} == {"b": 0.0, "c": 0.0}
