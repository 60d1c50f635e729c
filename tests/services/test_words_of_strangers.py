"""What an agent says of a task that it neither owns nor guards pauses nothing, and keeps no member from acting."""

from collections.abc import Iterator

import msgspec
import pytest
from services.counting import Count

from pancakes.durable.messages import REGISTRAR, Accepted, Call, Fact, Known, Prepare, Promise, WhoHas, addressed
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import NO_EPOCH, Epoch, Identity, Register
from pancakes.durable.snapshot import Snapshot
from pancakes.packet import Packet
from pancakes.security.access import Access
from pancakes.security.roster import RIGHTS, AccessRule, Right
from pancakes.testing import Fleet

COUNT, FREE = TaskId("a", "Count"), TaskId("a", "Free")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        guarded = {"type": Count, "guard": {"copies": 3, "lease_s": 2.0, "guardians": ["b", "c"]}}
        made.start("a", tasks={"Count": guarded, "Free": {"type": Count}})
        for name in "bcd":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: len(record(made).members) == 3 and len(record(made).register.sets) == 1, 10)
        made.run_for(1.0)
        yield made


def record(fleet: Fleet, task_id: TaskId = COUNT) -> Record:
    found = fleet.agents["a"].agent.records.get(task_id)
    assert found is not None
    return found


def identity(fleet: Fleet, name: str) -> Identity:
    return Identity(name, fleet.agents[name].agent.mesh.identity.journal)


def say(fleet: Fleet, speaker: str, message: msgspec.Struct, to: str) -> None:
    journal = fleet.agents[to].agent.mesh.identity.journal
    if hasattr(message, "journal"):
        message = addressed(message, journal)
    fleet.agents[speaker].publish("network", message, to=f"{to}/{REGISTRAR}")


def test_later_write_that_a_stranger_has_pauses_no_owner(fleet: Fleet):
    for _ in range(20):
        say(fleet, "d", Accepted(COUNT, record(fleet).epoch, identity(fleet, "d"), 2**60, 2**40), "a")
        fleet.run_for(0.2)
    assert "Count" in fleet.agents["a"].running() and not fleet.agents["a"].events("permit_lost")


def test_stranger_that_asks_again_and_again_puts_off_no_takeover(fleet: Fleet):
    fleet.crash("a")
    for _ in range(80):
        for name in "bc":
            say(fleet, "d", WhoHas((COUNT,), silent=True), name)
        fleet.run_for(0.1)
    assert [name for name in "bcd" if "Count" in fleet.agents[name].running()]


@pytest.mark.parametrize("owner", ["d", "z"], ids=["itself", "an agent that is nowhere"])
def test_claim_of_an_agent_that_may_host_nothing_pauses_no_task(fleet: Fleet, owner: str):
    kernel = fleet.agents["a"].kernel
    others: tuple[Right, ...] = tuple(right for right in RIGHTS if right not in ("host", "guard"))
    strict = Access("a", own=(AccessRule(("*",), others),))
    strict.bearer_of = kernel.access.bearer_of
    kernel.access = strict
    claim = Register(Epoch(5, identity(fleet, "d") if owner == "d" else Identity("z", "j")), 0)
    say(fleet, "d", Known(identity(fleet, "d"), (), (Fact(FREE, claim),)), "a")
    fleet.run_for(3.0)
    assert "Free" in fleet.agents["a"].running() and not record(fleet, FREE).disputed


@pytest.mark.parametrize("task_id", [COUNT, FREE], ids=["guarded", "not guarded"])
def test_agent_that_knows_nothing_of_a_task_takes_none_that_its_owner_has(fleet: Fleet, task_id: TaskId):
    """D names itself the only member, calls e, and promises it a state of its own making."""
    fleet.start("e")
    fleet.connect()
    fleet.run_for(1.0)
    d, version = identity(fleet, "d"), fleet.agents["a"].slot("Count").spec.version
    state = Snapshot(task_id, "test.Count", version, "client").encode()
    made_up = Register(Epoch(6, d), 9, ((d,),))

    def answer(packet: Packet) -> None:
        if isinstance(packet.body, Prepare):
            promise = Promise(task_id, packet.body.epoch, d, made_up._replace(promised=packet.body.epoch), state)
            say(fleet, "d", promise, "e")

    fleet.agents["d"].kernel.stream.tap("network", answer)
    for _ in range(20):
        say(fleet, "d", Call(task_id, "test.Count", "client", NO_EPOCH, ((d,),)), "e")
        fleet.run_for(0.2)
    assert task_id.name not in fleet.agents["e"].running() and task_id.name in fleet.agents["a"].running()
