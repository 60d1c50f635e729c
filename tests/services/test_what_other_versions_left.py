"""What other versions have left on disk: a task that cannot go on from it rests, and all else runs."""

from collections.abc import Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

import pytest
from msgspec.structs import replace
from services.counting import Count

from pancakes.control import Create, Describe, Guarding, Migrate, Restart, Start, Stop
from pancakes.durable.installed import Installed
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing
from pancakes.durable.snapshot import Snapshot
from pancakes.journal.journal import JournalEntry, seal, unseal
from pancakes.packet import SYSCTRL
from pancakes.task import Task
from pancakes.testing import AgentHandle, Fleet
from pancakes.util.plugins import UnknownPluginError

WHY = "what is on disk of it cannot be read: these 1 bytes are no snapshot of a task"
HOW = "`pancakes task restart --drop-state a/Count` begins it as its configuration says, without its state"


def change_record(
    disk: MutableMapping[str, bytes], journal: str, name: str, change: Callable[[Record], Record]
) -> None:
    """Has the record of a task of a say something else."""
    file = f"record.a%2F{name}.rec"
    entry = unseal(journal, disk[file])
    data = change(Record.decode(entry.data)).encode()
    disk[file] = seal(journal, JournalEntry(entry.kind, entry.key, data))


def with_state(record: Record, state: bytes) -> Record:
    """Returns the record with another state."""
    return replace(record, register=record.register._replace(state=state))


def rewritten(fleet: Fleet, name: str, snapshot: bytes | None = None, **changes: Any) -> AgentHandle:
    """Ends a, has the record of a task say something else, and starts a again."""
    journal = fleet.agents["a"].agent.mesh.identity.journal
    fleet.run_for(2.0)
    fleet.crash("a")
    disk = fleet.disk("a")

    def change(record: Record) -> Record:
        nonlocal snapshot
        if snapshot is None:
            snapshot = replace(Snapshot.decode(record.snapshot), **changes).encode()
        return with_state(record, snapshot)

    change_record(disk, journal, name, change)
    agent = fleet.restart("a")
    fleet.run_for(5.0)
    return agent


@pytest.mark.parametrize("guard", [{}, {"guard": {"copies": 3}}])
def test_a_configured_task_waits_until_a_person_drops_its_state(guard: dict[str, int]) -> None:
    with Fleet(2) as fleet:
        fleet.start("a", tasks={"Other": Count, "Count": {"type": Count, **guard}})
        fleet.start("b")
        fleet.start("c")
        fleet.connect()
        a = rewritten(fleet, "Count", b"\x80")
        assert a.running() == ["Other"]
        (told,) = [line for line in a.lines("error") if "a/client/Count" in line]
        assert told.startswith(f"a/client/Count was not started: {WHY}") and told.endswith(HOW)
        # It is tried again each second, and nothing is written for that.
        client: Any = a.component("client")
        place = client.places[TaskId("a", "Count")]
        record = place.record
        fleet.run_for(5.0)
        assert place.record is record
        assert a.ask(Describe("Count")).result["reason"].startswith(WHY)
        guarded = a.ask(Guarding())
        assert [row["task_id"] for row in guarded.result] == (["a/Count"] if guard else [])
        for body in (Start("Count"), Restart("Count")):
            assert a.ask(body).reason.startswith(WHY)

        assert a.ask(Restart("Count", keep_state=False)).ok
        fleet.run_for(2.0)
        assert a.ask(Stop("Count")).ok
        assert a.ask(Start("Count")).ok
        n = a.task("Count").state.n
        fleet.crash("a")
        again = fleet.restart("a")
        fleet.run_for(5.0)
        assert again.task("Count").state.n >= n and again.lines("error") == []


def test_a_stop_is_answered_and_outlives_the_agent() -> None:
    with Fleet(2) as fleet:
        fleet.start("a", tasks={"Other": Count, "Count": Count})
        a = rewritten(fleet, "Count", b"\x80")
        assert a.ask(Stop("Count")).ok
        fleet.crash("a")
        again = fleet.restart("a")
        fleet.run_for(2.0)
        assert again.running() == ["Other"] and again.lines("error") == []


@pytest.mark.parametrize(
    ("snapshot", "changes"), [(b"\x80", {}), (None, {"restart": {"policy": "daily"}}), (None, {"migrate": {"when": 3}})]
)
def test_a_task_that_no_file_names_harms_no_other(snapshot: bytes | None, changes: dict[str, Any]) -> None:
    with Fleet(2, classes={"test.Count": Count}) as fleet:
        a = fleet.start("a", tasks={"Other": Count})
        assert a.ask(Create("Count", "test.Count")).ok
        again = rewritten(fleet, "Count", snapshot, **changes)
        assert again.running() == ["Other"]
        assert any(line.startswith("a/Count rests in the journal") for line in again.lines("error"))


def test_what_was_to_follow_a_hand_over_and_cannot_be_read_is_said_once() -> None:
    with Fleet(2, classes={"test.Count": Count}) as fleet:
        a = fleet.start("a", tasks={"Home": {"type": Count, "start": False}, "Count": Count})
        fleet.start("b")
        fleet.connect()
        journal = a.agent.mesh.identity.journal
        a.publish(SYSCTRL, Migrate("Count", then="Home"))
        client: Any = a.component("client")
        place = client.places[TaskId("a", "Count")]
        while place.record.standing is not Standing.YIELDED:
            assert fleet.dispatcher.step()
        fleet.crash("a")
        change_record(fleet.disk("a"), journal, "Count", lambda record: replace(record, sequel=b"\xc1"))
        again = fleet.restart("a")
        fleet.run_for(20.0)
        assert again.running() == [] and fleet.agents["b"].running() == ["Count"]
        (told,) = again.lines("error")
        assert told.startswith("what was to follow the migration of a/Count is not done: ")
        fleet.crash("a")
        again = fleet.restart("a")
        fleet.run_for(20.0)
        assert again.lines("error") == []


class Earlier(Task):
    @dataclass
    class State:
        n: int = 7
        gone: int = 3


class Later(Task):
    @dataclass
    class State:
        n: int = 0
        new: int = 5


class Wider(Task):
    @dataclass
    class State:
        n: int = 0
        gone: int = 0
        new: int = 5

    state: State


def test_a_later_version_of_a_class_reads_what_an_earlier_one_saved() -> None:
    with Fleet(2) as fleet:
        fleet.start("a", tasks={"Task": Earlier})
        fleet.run_for(2.0)
        fleet.crash("a")
        wider = fleet.start("a", tasks={"Task": Wider})
        state: Wider.State = wider.task("Task").state
        assert (state.n, state.gone, state.new) == (7, 3, 5)
        fleet.run_for(2.0)
        fleet.crash("a")
        later = fleet.start("a", tasks={"Task": Later, "Other": Count})
        assert later.running() == ["Other"]
        assert any("bad state for Task: gone: unknown key" in line for line in later.lines("error"))
        assert later.ask(Restart("Task", keep_state=False)).ok
        assert later.task("Task").state == Later.State()


def test_a_guarded_task_whose_class_is_gone_on_its_agent_is_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    find = Installed.find
    known: set[int] = set()
    is_gone = False

    def find_in_known(installed: Installed, type_name: str) -> tuple[type[Task], str]:
        if not is_gone:
            known.add(id(installed))
        if id(installed) not in known:
            raise UnknownPluginError(f"unknown task type {type_name!r}", "")
        return find(installed, type_name)

    monkeypatch.setattr(Installed, "find", find_in_known)
    with Fleet(2, classes={"test.Count": Count}) as fleet:
        a = fleet.start("a")
        for name in "bc":
            fleet.start(name)
        fleet.connect()
        assert a.ask(Create("Count", "test.Count", keys={"guard": {"copies": 3, "lease_s": 2.0}})).ok
        fleet.run_for(10.0)
        fleet.crash("a")
        is_gone = True
        again = fleet.restart("a")
        fleet.connect()
        fleet.run_for(20.0)
        assert again.running() == [] and any("unknown task type 'test.Count'" in line for line in again.lines("error"))
        assert [name for name in "bc" if fleet.agents[name].running()] == ["b"], "its guardians know its class"
