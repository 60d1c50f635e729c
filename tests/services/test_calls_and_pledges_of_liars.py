"""A task is taken over at the word of its own guardians, and only where its owner does not have it any more."""

import pytest
from services.counting import Count

from pancakes.control import Guarding
from pancakes.durable.guarding import called, told
from pancakes.durable.messages import (
    CheckpointBody,
    CheckpointId,
    DenyLease,
    KeepLease,
    LeaseSeen,
    Nak,
    Pledge,
    Reserve,
    SeizeTask,
    Solicit,
    TakeTask,
    addressed,
)
from pancakes.durable.record import MOST_STEP, Epoch, GuardianId, Guards, Record, TaskId, Volatile, forgotten_guards
from pancakes.durable.snapshot import Snapshot
from pancakes.supervision.messages import GUARDIAN
from pancakes.testing import Fleet

COUNT, FREE = TaskId("a", "Count"), TaskId("a", "Free")
FIRST = Epoch(0, "a")


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        guarded = {"type": Count, "guard": 3, "lease_s": 2.0, "guardians": ["b", "c"]}
        made.start("a", tasks={"Count": guarded, "Free": {"type": Count}})
        for name in "bcde":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: record(made).guards.version == 2, 10)
        made.run_for(1.0)
        yield made


def record(fleet, name="a"):
    return fleet.agents[name].agent.records.get(COUNT)


def guardian(fleet, name):
    return GuardianId(name, fleet.agents[name].agent.mesh.identity.journal)


def say(fleet, speaker, message, to):
    journal = fleet.agents[to.split("/")[0]].agent.mesh.identity.journal
    fleet.agents[speaker].publish("network", addressed(message, journal), to=to)


def pledges(fleet, guards, task_id=COUNT):
    """D pledges all that it is asked for, and brings a checkpoint of its own making."""
    version = fleet.agents["a"].slot("Count").spec.version
    rule = {"guard": 3, "lease_s": 2.0, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    body = CheckpointBody(Snapshot(task_id, "test.Count", version, "client", guard=rule).encode())

    def answer(packet):
        if isinstance(packet.body, SeizeTask):
            asked, me = packet.body, guardian(fleet, "d")
            pledge = Pledge(asked.task_id, asked.epoch, me, CheckpointId(Epoch(6, "d"), 9), guards, body)
            say(fleet, "d", pledge, packet.source)

    fleet.agents["d"].kernel.stream.tap("network", answer)


def runs_once(fleet, name="Count"):
    fleet.run_for(4.0)
    return [agent.name for agent in fleet.agents.values() if name in agent.running()] == ["a"]


@pytest.mark.parametrize("taker", ["b", "e"], ids=["a guardian", "an agent that knows nothing of it"])
@pytest.mark.parametrize("task_id", [COUNT, FREE], ids=["guarded", "not guarded"])
def test_task_is_not_taken_at_the_call_of_an_agent_that_does_not_guard_it(fleet, taker, task_id):
    """D names itself its only guardian, and pledges itself."""
    mine = Guards(Epoch(7, "d"), 0, ((guardian(fleet, "d"),),))
    pledges(fleet, mine, task_id)
    say(fleet, "d", TakeTask(task_id, "test.Count", FIRST, mine, CheckpointId(FIRST, 1)), f"{taker}/client")
    assert runs_once(fleet, task_id.name)
    assert fleet.agents[taker].running() == []


def test_pledges_and_denials_of_an_agent_that_does_not_guard_it_change_nothing(fleet):
    """B is to take it over, as its owner has gone; D knows the epoch that B asks for."""
    b, mine = fleet.agents["b"], Guards(Epoch(7, "d"), 9, ((guardian(fleet, "d"),),))
    pledges(fleet, mine)
    epoch, me = Epoch(1, "b"), guardian(fleet, "d")
    asked = []
    b.kernel.stream.tap_outgoing(lambda packet: asked.append(packet) if isinstance(packet.body, SeizeTask) else None)
    call = TakeTask(COUNT, "test.Count", FIRST, record(fleet).guards, CheckpointId(FIRST, 1))
    fleet.crash("a")
    say(fleet, "c", call, "b/client")
    assert fleet.run_until(lambda: asked, 2.0)
    body = CheckpointBody(Snapshot(COUNT, "test.Count", "", "client").encode())
    say(fleet, "d", Pledge(COUNT, epoch, me, CheckpointId(Epoch(6, "d"), 9), mine, body), "b/client")
    say(fleet, "d", DenyLease(COUNT, epoch, me, Epoch(2**60, "d"), "why"), "b/client")
    fleet.run_for(8.0)
    assert not [packet for packet in asked if packet.destination.startswith("d/")]
    assert [agent.name for agent in fleet.agents.values() if agent.running()] in (["b"], ["c"], ["e"])


def test_owner_that_has_gone_is_replaced_whatever_a_stranger_says_of_the_guardians(fleet):
    """D tells the guardians of others, and of an epoch that is out of reach."""
    fleet.crash("a")
    mine = Guards(Epoch(7, "d"), 9, ((guardian(fleet, "d"),),))
    for _ in range(60):
        for name in "bc":
            seen = LeaseSeen(COUNT, guardian(fleet, "d"), False, Epoch(MOST_STEP * 2, "d"), mine)
            say(fleet, "d", seen, f"{name}/{GUARDIAN}")
        fleet.run_for(0.1)
    fleet.run_for(4.0)
    assert [agent.name for agent in fleet.agents.values() if "Count" in agent.running()] in (["b"], ["c"], ["e"])


def test_guardian_does_not_let_go_of_a_task_whose_lease_runs(fleet):
    """C guards it as well, and says that it was removed."""
    say(fleet, "c", LeaseSeen(COUNT, guardian(fleet, "c"), False, FIRST, forgotten_guards(FIRST)), f"b/{GUARDIAN}")
    assert runs_once(fleet)
    fleet.crash("a")
    fleet.run_for(10.0)
    assert [agent.name for agent in fleet.agents.values() if "Count" in agent.running()]


def test_made_up_tasks_are_guarded_only_up_to_a_bound_after_they_were_removed(fleet, monkeypatch):
    monkeypatch.setattr("pancakes.durable.guardian.MOST_FORGOTTEN", 5)
    b, me = fleet.agents["b"], guardian(fleet, "b")
    epoch = Epoch(0, "d")
    for number in range(20):
        task_id, guards = TaskId("d", f"T{number}"), Guards(epoch, 0, ((me, guardian(fleet, "d")),))
        for sets in (guards, forgotten_guards(epoch)):
            keep = KeepLease(task_id, "test.Count", epoch, 1, 0.5, CheckpointId(epoch, 1), sets, CheckpointBody(b"x"))
            say(fleet, "d", keep, f"b/{GUARDIAN}")
            fleet.run_for(0.05)
    said = [line for line in b.lines("warning") if "remembers 5 removed tasks of d, and takes no new one" in line]
    assert len(said) == 1
    assert [row["task_id"] for row in b.ask(Guarding()).result] == ["a/Count"]


def test_owner_without_a_permit_is_replaced_although_the_taker_is_linked_to_it(fleet):
    """Its guardians do not hear it, and the others do."""
    fleet.faults.cut("a", off=("b", "c"))
    fleet.run_for(12.0)
    assert [agent.name for agent in fleet.agents.values() if "Count" in agent.running()] != ["a"]
    assert not fleet.agents["a"].component("client").places[COUNT].permit


def test_task_is_not_handed_over_by_a_stranger_while_its_owner_has_no_permit(fleet):
    fleet.faults.cut("a", off=("b", "c"))
    fleet.run_for(2.1)
    declined = []
    fleet.agents["d"].kernel.stream.tap("network", lambda packet: declined.append(packet.body))
    version = fleet.agents["a"].slot("Count").spec.version
    request = Solicit(COUNT, 1, "test.Count", version, "client")
    say(fleet, "d", Reserve(COUNT, Epoch(9, "d"), request), "e/client")
    fleet.run_for(0.5)
    assert "d has no right to it" in next(body.refusal.text for body in declined if isinstance(body, Nak))


def test_one_guardian_alone_has_no_task_taken_over(fleet):
    """C guards it indeed, and says that it alone does, by the owner's word, and that the owner is silent."""
    mine, b = Guards(Epoch(7, "c"), 0, ((guardian(fleet, "c"),),)), fleet.agents["b"]
    say(fleet, "c", TakeTask(COUNT, "test.Count", FIRST, mine, CheckpointId(FIRST, 1)), "b/client")
    assert runs_once(fleet) and not b.events("task_called")
    assert any("a has a/Count, under the epoch 0@a" in line for line in b.lines("warning"))


def test_guards_that_one_guardian_tells_of_do_not_decide_alone(fleet):
    """Those that the taker knows itself must pledge themselves too, more than half of them."""
    a, b, c = (guardian(fleet, name) for name in "abc")
    own, alone = Guards(FIRST, 2, ((a, b, c),)), Guards(Epoch(7, "c"), 0, ((c,),))
    call = TakeTask(COUNT, "test.Count", FIRST, alone, CheckpointId(FIRST, 1))
    seizing = called("b", Record(COUNT), Volatile(), call, own)
    assert seizing is not None and set(seizing.unasked()) == {a, b, c}
    body = CheckpointBody(b"state")
    seizing = told(seizing, Pledge(COUNT, seizing.epoch, c, CheckpointId(FIRST, 1), alone, body))
    assert seizing.result() is None
    seizing = told(seizing, Pledge(COUNT, seizing.epoch, b, CheckpointId(FIRST, 1), own, body))
    assert seizing.result() is not None
