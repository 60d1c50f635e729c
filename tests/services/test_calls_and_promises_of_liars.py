"""A task is taken over at the word of its own members, and only if its owner does not have it any more."""

from collections.abc import Iterator
from typing import Any

import pytest
from services.counting import Count
from services.strangers import identity, say, tell

from pancakes.control import Guarding, Migrate
from pancakes.durable import quotas
from pancakes.durable.messages import Accept, Bid, Call, Fact, Prepare, Promise, Refuse, Solicit
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import NO_EPOCH, Epoch, Register, Wanted
from pancakes.durable.rules import MOST_STEP
from pancakes.durable.snapshot import Snapshot
from pancakes.packet import Packet
from pancakes.testing import Fleet

COUNT, FREE = TaskId("a", "Count"), TaskId("a", "Free")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        guarded = {"type": Count, "guard": {"copies": 3, "lease_s": 2.0, "guardians": ["b", "c"]}}
        made.start("a", tasks={"Count": guarded, "Free": {"type": Count}})
        for name in "bcde":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: len(record(made).register.sets) == 1 and record(made).guarded, 10)
        made.run_for(1.0)
        yield made


def record(fleet: Fleet, name: str = "a") -> Record:
    found = fleet.agents[name].agent.records.get(COUNT)
    assert found is not None
    return found


def made_up(fleet: Fleet, n: int = 6, task_id: TaskId = COUNT) -> tuple[Register, bytes]:
    """Returns a register of d, which is its only member, and its state."""
    d, version = identity(fleet, "d"), Snapshot.decode(record(fleet, "b").snapshot).version
    rule = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    return Register(Epoch(n, d), 9, ((d,),)), Snapshot(task_id, "test.Count", version, "client", guard=rule).encode()


def promises(fleet: Fleet, task_id: TaskId = COUNT) -> None:
    """D promises all that it is asked for, and brings a state of its own making."""
    register, state = made_up(fleet, task_id=task_id)

    def answer(packet: Packet) -> None:
        if isinstance(packet.body, Prepare):
            held, taker = register._replace(promised=packet.body.epoch), packet.source.split("/")[0]
            say(fleet, "d", Promise(task_id, packet.body.epoch, identity(fleet, "d"), held, state), taker)

    fleet.agents["d"].kernel.stream.tap("network", answer)


def prepares(fleet: Fleet, name: str) -> list[Packet]:
    """Returns what an agent asks for promises from now on; the list grows."""
    asked: list[Packet] = []
    stream = fleet.agents[name].kernel.stream
    stream.tap_outgoing(lambda packet: asked.append(packet) if isinstance(packet.body, Prepare) else None)
    return asked


def where(fleet: Fleet, name: str = "Count") -> list[str]:
    return [agent.name for agent in fleet.agents.values() if name in agent.running()]


def runs_once(fleet: Fleet, name: str = "Count") -> bool:
    fleet.run_for(4.0)
    return where(fleet, name) == ["a"]


@pytest.mark.parametrize("taker", ["b", "e"], ids=["a member", "an agent that knows nothing of it"])
@pytest.mark.parametrize("task_id", [COUNT, FREE], ids=["guarded", "not guarded"])
def test_task_is_not_taken_at_the_call_of_an_agent_that_does_not_guard_it(
    fleet: Fleet, taker: str, task_id: TaskId
) -> None:
    """D names itself its only member, and promises itself."""
    promises(fleet, task_id)
    say(fleet, "d", Call(task_id, "test.Count", "client", NO_EPOCH, ((identity(fleet, "d"),),)), taker)
    assert runs_once(fleet, task_id.name)
    assert fleet.agents[taker].running() == []


def test_promises_of_an_agent_that_does_not_guard_it_change_nothing(fleet: Fleet) -> None:
    """B is to take it over, as its owner has gone; D knows the epoch that B asks for."""
    asked, sets = prepares(fleet, "b"), record(fleet).register.sets
    fleet.crash("a")
    say(fleet, "c", Call(COUNT, "test.Count", "client", record(fleet, "b").epoch, sets), "b")
    assert fleet.run_until(lambda: bool(asked), 2.0)
    register, state = made_up(fleet)
    d, epoch = identity(fleet, "d"), asked[0].body.epoch
    say(fleet, "d", Promise(COUNT, epoch, d, register._replace(promised=epoch), state), "b")
    tell(fleet, "d", "b", Fact(COUNT, register._replace(epoch=Epoch(2**50, d))))
    fleet.run_for(8.0)
    assert not [packet for packet in asked if str(packet.destination).startswith("d/")]
    assert where(fleet) in (["b"], ["c"], ["e"])


def test_owner_that_has_gone_is_replaced_whatever_a_stranger_says_of_the_members(fleet: Fleet) -> None:
    """D tells of other members, and of an epoch that is out of reach."""
    d = identity(fleet, "d")
    fleet.crash("a")
    for _ in range(60):
        for name in "bc":
            tell(fleet, "d", name, Fact(COUNT, Register(Epoch(MOST_STEP * 2, d), 9, ((d,),))), task_ids=(COUNT,))
            tell(fleet, "d", name, Fact(COUNT, Register(Epoch(7, d), 9, ((d,),))), task_ids=(COUNT,))
        fleet.run_for(0.1)
    fleet.run_for(4.0)
    assert where(fleet) in (["b"], ["c"], ["e"])


def test_made_up_tasks_are_remembered_only_up_to_a_bound(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quotas, "MOST_LEFT", 5)
    b, pair = fleet.agents["b"], (identity(fleet, "b"), identity(fleet, "d"))
    for number in range(20):
        task_id, register = TaskId("d", f"T{number}"), Register(Epoch(0, pair[1]), 1, (pair,))
        gone = register._replace(no=2, wanted=Wanted.REMOVED)
        for write, state in ((register, b"x"), (gone, None)):
            say(fleet, "d", Accept(task_id, "test.Count", "client", write, 1, 0.5, state=state), "b")
            fleet.run_for(0.05)
    assert any("remembers 5 tasks of d, and no more" in line for line in b.lines("warning"))
    assert len([it for it in b.agent.records.all() if it.birthplace == "d"]) <= 6


@pytest.mark.parametrize("how", ["asks for promises", "offers"])
def test_tasks_that_a_stranger_makes_up_are_bounded(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    monkeypatch.setattr(quotas, "MOST_LEFT", 5)
    b, (one, d) = fleet.agents["b"], (identity(fleet, "b"), identity(fleet, "d"))
    for number in range(20):
        task_id = TaskId("d", f"T{number}")
        if how == "offers":
            register = Register(Epoch(0, d), 1, ((d,),), heir=one)
            say(fleet, "d", Accept(task_id, "test.Count", "client", register, to=one, state=b"x"), "b")
        else:
            say(fleet, "d", Prepare(task_id, "test.Count", Epoch(5, d), (NO_EPOCH, 0), ((one,),)), "b")
        fleet.run_for(0.1)
    assert len([it for it in b.agent.records.all() if it.birthplace == "d"]) <= 6
    assert [row["task_id"] for row in b.ask(Guarding()).result] == ["a/Count"]


def test_owner_without_a_permit_is_replaced_although_the_taker_is_linked_to_it(fleet: Fleet) -> None:
    """Its members do not hear it, and the others do."""
    fleet.faults.cut("a", off=("b", "c"))
    fleet.run_for(12.0)
    a = fleet.agents["a"]
    acts = a.component("client/Count") and a.kernel.permits.may_act(a.component("client/Count").fence)
    assert where(fleet) != ["a"] and not acts


def test_task_is_not_handed_over_by_a_stranger_while_its_owner_has_no_permit(fleet: Fleet) -> None:
    fleet.faults.cut("a", off=("b", "c"))
    fleet.run_for(2.1)
    answers: list[Any] = []
    fleet.agents["d"].kernel.stream.tap("network", lambda packet: answers.append(packet.body))
    version = fleet.agents["a"].slot("Count").spec.version
    request = Solicit(COUNT, 1, "test.Count", version, "client", hold=True)
    say(fleet, "d", request, "e", "network/TaskMigrator")
    fleet.run_for(0.5)
    (answer,) = [it for it in answers if isinstance(it, Refuse | Bid)]
    assert isinstance(answer, Refuse) and "d has no right to it" in answer.refusal.text


def replaced(fleet: Fleet) -> str:
    """Has the task taken over from a, which is away so long that it guards the task no more; returns the owner."""
    fleet.crash("a")
    assert fleet.run_until(lambda: len(where(fleet)) == 1, 20.0)
    (owner,) = where(fleet)
    fleet.run_for(80.0)
    assert "a" not in {it.agent for one in record(fleet, owner).register.sets for it in one}
    return owner


def come_back(fleet: Fleet, off: str) -> list[Packet]:
    """Starts a again, which some agents do not reach, and lets five seconds pass; returns what it was told in them."""
    told: list[Packet] = []
    fleet.restart("a").kernel.stream.tap("network", told.append)
    if off:
        fleet.faults.cut("a", off=tuple(off))
    fleet.run_for(5.0)
    return told


@pytest.mark.parametrize("off", ["b", "c", "bc", "bcd", "cde", "bcde"])
def test_task_that_was_taken_over_moves_on_although_its_birthplace_has_not_learned_it(fleet: Fleet, off: str) -> None:
    """Too few agents reach a, which takes itself for the owner still. It does not ask them over and over."""
    owner = replaced(fleet)
    told = come_back(fleet, off)
    assert where(fleet) == [owner] and record(fleet, "a").owned, "or this proves nothing"
    assert len(told) < 50
    other = next(name for name in "de" if name != owner)
    assert fleet.agents[owner].ask(Migrate("Count", to=other)).ok
    fleet.run_for(2.0)
    assert where(fleet) == [other]


def test_task_that_was_taken_over_moves_on_although_no_other_guardian_of_its_birthplace_is_left(fleet: Fleet) -> None:
    """Its new guardians know it themselves."""
    owner = replaced(fleet)
    members = {it.agent for one in record(fleet, owner).register.sets for it in one}
    fleet.crash("c" if owner == "b" else "b")
    come_back(fleet, "")
    assert where(fleet) == [owner] and record(fleet, "a").owned, "or this proves nothing"
    other = next(name for name in "de" if name != owner and name in members)
    assert fleet.agents[owner].ask(Migrate("Count", to=other)).ok
    fleet.run_for(2.0)
    assert where(fleet) == [other]


def test_birthplace_of_a_task_that_was_taken_over_has_nothing_left_of_it_once_it_has_come_back(fleet: Fleet) -> None:
    owner = replaced(fleet)
    come_back(fleet, "")
    assert where(fleet) == [owner] and not record(fleet, "a").owned


def test_one_member_alone_has_no_task_taken_over(fleet: Fleet) -> None:
    """C guards it indeed, and says that it alone does, by the owner's word, and that the owner is silent."""
    c = identity(fleet, "c")
    for taker in "be":
        say(fleet, "c", Call(COUNT, "test.Count", "client", Epoch(7, c), ((c,),)), taker)
        assert runs_once(fleet)
        assert record(fleet).epoch.n == 0 and not fleet.agents["a"].events("permit_lost")
