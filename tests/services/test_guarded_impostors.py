"""What is said about a guarded task by an agent that has no right to say it changes nothing."""

from collections.abc import Iterator
from typing import Any

import pytest
from msgspec.structs import replace
from services.counting import Count
from services.strangers import identity, say, tell

from pancakes.control import Guarding
from pancakes.durable.messages import REGISTRAR, Accept, Accepted, Call, Fact, Known, Prepare, Promise, addressed
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Register, Wanted
from pancakes.durable.snapshot import Snapshot
from pancakes.packet import Packet
from pancakes.security.access import Access
from pancakes.security.roster import RIGHTS, AccessRule, Right
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start(
            "a", tasks={"Count": {"type": Count, "guard": {"copies": 3, "lease_s": 2.0, "guardians": ["b", "c"]}}}
        )
        for name in "bcd":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: len(record(made).members) == 3, 10)
        made.run_for(1.0)
        assert len(record(made).register.sets) == 1 and record(made).guarded
        yield made


def record(fleet: Fleet, name: str = "a") -> Record:
    found = fleet.agents[name].agent.records.get(COUNT)
    assert found is not None
    return found


def high(fleet: Fleet, name: str = "d", n: int = 7) -> Epoch:
    return Epoch(n, identity(fleet, name))


def sets(fleet: Fleet) -> Any:
    return record(fleet).register.sets


def entry(fleet: Fleet, name: str) -> Any:
    return fleet.agents[name].component(REGISTRAR).entries[COUNT]


def heard_by(fleet: Fleet, name: str) -> list[Any]:
    """Returns what an agent is told from now on; the list grows."""
    told: list[Any] = []
    fleet.agents[name].kernel.stream.tap("network", lambda packet: told.append(packet.body))
    return told


def call(fleet: Fleet, speaker: str, to: str) -> None:
    say(fleet, speaker, Call(COUNT, "test.Count", "client", record(fleet).epoch, sets(fleet)), to)


def cut_off_from_owner(fleet: Fleet) -> None:
    """B is not linked to a, which would say that it has the task; c is."""
    fleet.network.partition(["a"], ["b"])
    fleet.run_for(3.0)


def goes_on(fleet: Fleet) -> bool:
    fleet.run_for(3.0)
    a = fleet.agents["a"]
    return a.running() == ["Count"] and record(fleet).epoch.n == 0 and not a.events("permit_lost")


def test_leases_are_granted_by_members_alone(fleet: Fleet) -> None:
    a = fleet.agents["a"]
    fleet.faults.cut("a", off=("b", "c"))
    for _ in range(40):
        beat, register = entry(fleet, "a").held.beat, record(fleet).register
        for name in "bcd":
            say(fleet, "d", Accepted(COUNT, register.epoch, identity(fleet, name), beat, register.no), "a")
        fleet.run_for(0.1)
    assert a.events("permit_lost")


def test_an_owner_believes_only_a_member_that_it_was_passed(fleet: Fleet) -> None:
    passed = record(fleet).register.summary()._replace(promised=high(fleet))
    for name in "bcd":
        say(fleet, "d", Known(identity(fleet, name), (), (Fact(COUNT, passed),)), "a")
    assert goes_on(fleet)


def test_promises_are_of_members_alone(fleet: Fleet) -> None:
    b, asked = fleet.agents["b"], []
    b.kernel.stream.tap_outgoing(lambda packet: asked.append(packet) if isinstance(packet.body, Prepare) else None)
    cut_off_from_owner(fleet)
    call(fleet, "c", "b")
    assert fleet.run_until(lambda: bool(asked), 1.0)
    lie = Register(high(fleet), 9, sets(fleet))
    for name in "abcd":
        say(fleet, "d", Promise(COUNT, asked[0].body.epoch, identity(fleet, name), lie, record(fleet).snapshot), "b")
    assert goes_on(fleet) and b.running() == []


def test_a_lease_is_given_up_by_its_owner_alone(fleet: Fleet) -> None:
    register = record(fleet).register
    for name in "bc":
        for later in range(1, 4):
            goodbye = register.summary()._replace(no=register.no + later, heir=identity(fleet, "d"))
            say(fleet, "d", Accept(COUNT, "test.Count", "client", goodbye, state=register.state), name)
    assert goes_on(fleet)


def test_lease_that_runs_is_ended_by_no_claim_of_another(fleet: Fleet) -> None:
    """It asks for promises, or for a lease of half a second under an epoch of its own, and is silent then."""
    told = heard_by(fleet, "d")
    kind, epoch, first = record(fleet).type, high(fleet), record(fleet).register
    ours = Register(epoch, 1, sets(fleet))
    claims = [
        Prepare(COUNT, kind, epoch, first.stamp, first.sets),
        Accept(COUNT, kind, "client", ours, 1, 0.5, state=b"a lie"),
        Accept(COUNT, kind, "client", ours._replace(wanted=Wanted.REMOVED), 1, 0.5),
        Accept(COUNT, kind, "client", ours._replace(heir=identity(fleet, "b")), 1, 0.5, state=b"a lie"),
    ]
    for claim in claims:
        for name in "abc":
            say(fleet, "d", claim, name)
        fleet.run_for(0.5)
    assert not [it for it in told if isinstance(it, Promise | Accepted)]
    assert goes_on(fleet)
    assert [fleet.agents[name].ask(Guarding()).result[0]["epoch"] for name in "bc"] == [str(first.epoch)] * 2


def test_what_another_says_of_a_member_has_no_task_taken_over(fleet: Fleet) -> None:
    b = fleet.agents["b"]
    fleet.faults.cut("b", off=("a", "c"))
    lie = Register(high(fleet), 9, sets(fleet))
    for _ in range(50):
        for name in "acd":
            say(fleet, "d", Known(identity(fleet, name), (COUNT,), (Fact(COUNT, lie),)), "b")
        fleet.run_for(0.1)
    assert not b.events("task_called") and not fleet.agents["d"].events("task_called")
    assert fleet.agents["a"].running() == ["Count"]


def test_a_task_is_removed_by_the_word_of_its_owner_alone(fleet: Fleet) -> None:
    gone = Register(high(fleet), 9, sets(fleet), wanted=Wanted.REMOVED)
    tell(fleet, "d", "b", Fact(COUNT, gone))
    tell(fleet, "c", "b", Fact(COUNT, record(fleet).register.summary()._replace(wanted=Wanted.REMOVED)))
    tell(fleet, "c", "b", Fact(TaskId("a", "Nothing"), gone))
    assert goes_on(fleet)
    assert [row["task_id"] for row in fleet.agents["b"].ask(Guarding()).result] == ["a/Count"]
    fleet.crash("a")
    fleet.run_for(10.0)
    assert [agent.name for agent in fleet.agents.values() if "Count" in agent.running()]


def test_what_was_meant_for_an_agent_with_another_disk_has_no_effect(fleet: Fleet) -> None:
    c, b = fleet.agents["c"], fleet.agents["b"]
    cut_off_from_owner(fleet)
    body = Call(COUNT, "test.Count", "client", record(fleet).epoch, sets(fleet))
    c.publish("network", addressed(body, "another"), to=f"b/{REGISTRAR}")
    fleet.run_for(0.5)
    assert not b.events("task_called")
    call(fleet, "c", "b")
    assert fleet.run_until(lambda: bool(b.events("task_called")), 1.0)


def test_a_peer_without_the_right_to_guard_calls_no_agent(fleet: Fleet) -> None:
    b = fleet.agents["b"]
    others: tuple[Right, ...] = tuple(right for right in RIGHTS if right != "guard")
    strict = Access("b", own=(AccessRule(("*",), others),))
    strict.bearer_of = b.kernel.access.bearer_of
    b.kernel.access = strict
    call(fleet, "c", "b")
    fleet.run_for(0.5)
    assert not b.events("task_called")


@pytest.mark.parametrize("moves", [None, {"when": 5}], ids=["no snapshot", "a malformed rule"])
def test_a_member_outlives_a_state_that_cannot_be_read(fleet: Fleet, moves: dict[str, int] | None) -> None:
    bad = TaskId("d", "Bad")
    rule = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    state = Snapshot(bad, "test.Count", "", "client", guard=rule, migrate=moves).encode() if moves else b"bad"
    register = Register(high(fleet, n=0), 1, (tuple(identity(fleet, name) for name in "bcd"),))
    for name in "bc":
        say(fleet, "d", Accept(bad, "test.Count", "client", register, 1, 1.0, state=state), name)
    fleet.run_for(5.0)
    b = fleet.agents["b"]
    assert any("d/Bad cannot be taken over" in line for line in b.lines("error"))
    assert {row["task_id"] for row in b.ask(Guarding()).result} == {"a/Count", "d/Bad"}
    assert goes_on(fleet)


def test_a_promise_with_a_state_that_cannot_be_read_does_not_count(fleet: Fleet) -> None:
    b, asked = fleet.agents["b"], list[Packet]()
    b.kernel.stream.tap_outgoing(lambda packet: asked.append(packet) if isinstance(packet.body, Prepare) else None)
    cut_off_from_owner(fleet)
    call(fleet, "c", "b")
    assert fleet.run_until(lambda: bool(asked), 1.0)
    for state in (b"x", replace(Snapshot.decode(record(fleet).snapshot), task_id=TaskId("a", "Other")).encode()):
        lie = Register(high(fleet), 9, sets(fleet))
        say(fleet, "c", Promise(COUNT, asked[0].body.epoch, identity(fleet, "c"), lie, state), "b")
        assert goes_on(fleet) and b.running() == []
    assert any("does not count" in line for line in b.lines("warning"))


def test_agent_that_has_never_heard_of_a_task_asks_its_birthplace_before_it_guards_it(fleet: Fleet) -> None:
    """Otherwise d would follow c, and refuse to guard the task for a, for ever."""
    epoch = high(fleet, "c")
    lie = Register(epoch, 1, ((identity(fleet, "c"), identity(fleet, "d")),), promised=epoch)
    say(fleet, "c", Accept(COUNT, "test.Count", "client", lie, state=record(fleet).snapshot), "d")
    fleet.run_for(2.0)
    assert fleet.agents["d"].agent.records.get(COUNT) is None
    assert any("c has no right to it" in line for line in fleet.agents["d"].lines("warning"))
