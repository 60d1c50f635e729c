"""The disk of an agent is an old copy, as a restored backup is: others notice, and its tasks wait until they told."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from msgspec.structs import replace
from services.numbered import Sink
from services.strangers import identity, owns, tell

from pancakes.control import Adopt, Describe, Migrate, Restart, Start
from pancakes.durable import questions
from pancakes.durable.messages import REGISTRAR, BootRemembered, Known
from pancakes.durable.questions import Finding, copied_task
from pancakes.durable.record import TaskId
from pancakes.durable.register import MORE_THAN_MIGRATIONS, Epoch, Identity, Register
from pancakes.durable.register_messages import KnownCame
from pancakes.packet import NETWORK
from pancakes.testing import AgentHandle, Fleet

TASKS = {"Sink": Sink, "Other": Sink}
SAYS = "takes the disk of a for an old copy"


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=11) as made:
        yield made


def state(agent: AgentHandle, task: str = "Sink") -> tuple[str, str]:
    found = agent.ask(Describe(target=task)).result
    return found["state"], found["rest"]


def copy_of(fleet: Fleet, name: str) -> dict[str, bytes]:
    return {file: data for file, data in fleet.disk(name).items() if file != "lock"}


def put(fleet: Fleet, name: str, disk: dict[str, bytes]) -> None:
    fleet.disk(name).clear()
    fleet.disk(name).update(disk)


def begun(fleet: Fleet, others: str, text: str = "") -> dict[str, bytes]:
    """Agent a with two tasks, and the others; returns a's disk, after which a was started twice again."""
    fleet.start("a", text, tasks=TASKS)
    for name in others:
        fleet.start(name, classes={"Sink": Sink})
    fleet.connect()
    fleet.run_for(0.5)
    disk = copy_of(fleet, "a")
    for _ in range(2):
        fleet.stop("a")
        fleet.restart("a")
        fleet.connect()
        fleet.run_for(0.5)
    return disk


def restored(fleet: Fleet, disk: dict[str, bytes]) -> AgentHandle:
    if "a" in fleet.agents:
        fleet.crash("a")
    put(fleet, "a", disk)
    return fleet.restart("a")


def test_two_that_say_so_and_know_of_no_later_owner_let_the_tasks_go_on(fleet: Fleet):
    a = restored(fleet, begun(fleet, "bc"))
    fleet.connect()
    fleet.run_for(2.0)
    assert state(a)[0] == state(a, "Other")[0] == "running"
    assert sorted(line[:1] for line in a.lines("warning") if SAYS in line) == ["b", "c"]
    (told,) = a.events("old_copy")
    assert sorted(told["peers"].split(", ")) == ["b", "c"]
    stopped = [it["task"] for it in a.events("task_stopped")]
    assert sorted(stopped) == ["Other", "Sink"], "they stood still meanwhile"
    for other in "bc":
        assert any("the disk of a is an old copy" in it for it in fleet.agents[other].lines("warning"))


def test_what_went_on_elsewhere_stands_still_until_a_person_decides(fleet: Fleet):
    disk = begun(fleet, "bcd")
    assert fleet.agents["a"].ask(Migrate("Sink", to="b")).ok
    fleet.run_for(2.0)
    assert fleet.agents["b"].ask(Migrate("Sink", to="d")).ok
    fleet.run_for(2.0)
    fleet.crash("d")
    a = restored(fleet, disk)
    fleet.run_until(lambda: len(a.agent.mesh.connected()) == 2)
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "disputed") and state(a, "Other")[0] == "running"
    assert [(it["task"], it["peer"]) for it in a.events("task_disputed")] == [("Sink", "d")], "d is off, and b knows"
    d = fleet.restart("d")
    fleet.connect()
    fleet.run_for(2.0)
    assert state(d)[0] == "running" and state(a) == ("stopped", "disputed")
    assert a.ask(Adopt("Sink")).ok
    fleet.run_for(1.0)
    assert state(a)[0] == "running" and state(d) == ("stopped", "disputed")


def test_one_that_says_so_alone_warns(fleet: Fleet):
    a = restored(fleet, begun(fleet, "b"))
    fleet.connect()
    fleet.run_for(2.0)
    assert sum(SAYS in line for line in a.lines("warning")) == 1
    assert a.events("old_copy") == a.events("task_stopped") == []


def test_a_copy_of_the_last_start_is_noticed_too(fleet: Fleet):
    begun(fleet, "bc")
    fleet.stop("a")
    disk = copy_of(fleet, "a")
    fleet.restart("a")
    fleet.connect()
    fleet.run_for(0.5)
    a = restored(fleet, disk)
    fleet.connect()
    fleet.run_for(2.0)
    assert len(a.events("old_copy")) == 1
    assert any("another start of its journal with the same number" in line for line in a.lines("warning"))


def test_it_is_remembered_over_a_start_of_the_whole_fleet(fleet: Fleet):
    disk = begun(fleet, "bc")
    for name in "abc":
        fleet.crash(name)
    put(fleet, "a", disk)
    for name in "bca":
        fleet.restart(name)
    fleet.connect()
    fleet.run_for(2.0)
    assert len(fleet.agents["a"].events("old_copy")) == 1


def test_an_agent_that_starts_again_and_again_is_no_copy(fleet: Fleet):
    begun(fleet, "bc")
    for how in ("crash", "stop", "crash"):
        getattr(fleet, how)("a")
        a = fleet.restart("a")
        fleet.connect()
        fleet.run_for(1.0)
        assert a.lines("warning") == []
    fleet.faults.break_link("a", "b")
    fleet.run_for(3.0)
    assert a.lines("warning") == []


def test_an_agent_with_a_new_disk_is_no_copy_and_its_old_disk_is_one(fleet: Fleet):
    disk = begun(fleet, "bc")
    a = restored(fleet, {})
    fleet.connect()
    fleet.run_for(1.0)
    assert a.events("old_copy") == []
    a = restored(fleet, disk)
    fleet.connect()
    fleet.run_for(1.0)
    assert len(a.events("old_copy")) == 1


# Until they have told ----------------------------------------------------------------------------------------------


def silent(fleet: Fleet, text: str = "") -> AgentHandle:
    """Agents b and c say that a has an old copy for a disk, and answer nothing."""
    begun(fleet, "bc", text)
    for name in "bc":
        registrar = fleet.agents[name].component(REGISTRAR)
        assert registrar is not None
        registrar.stop()
    fleet.run_for(0.5)
    for name in "bc":
        lies(fleet, name)
    fleet.run_for(3.0)
    return fleet.agents["a"]


def test_until_they_have_told_all_its_tasks_stand_still_and_it_says_why(fleet: Fleet):
    a = silent(fleet)
    for task in TASKS:
        assert state(a, task) == ("stopped", "old copy")
        refused = a.ask(Start(task))
        assert not refused.ok and f"a/{task} may be elsewhere by now" in refused.reason
        assert not a.ask(Start(task, dry_run=True)).ok
    assert not a.ask(Migrate("Sink", to="b")).ok
    assert sum("its tasks are paused until these have told where they are" in it for it in a.lines("error")) == 1
    assert a.ask(Restart("client")).ok
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "old copy"), "a service that begins anew is told too"
    for name in "bc":
        fleet.crash(name)
        fleet.restart(name)
    fleet.run_for(4.0)
    assert state(a)[0] == state(a, "Other")[0] == "running", "they are asked again, and tell"


@pytest.mark.parametrize("ends", ["its link", "its right"])
def test_an_answer_counts_only_of_an_agent_that_may_give_it(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, ends: str):
    """That ends after the registrar has taken the answer, and before the service looks at it."""
    a = silent(fleet, ALLOWED.replace('"publish"', '"publish", "host"'))
    made = [(who, Known(identity(fleet, who), (TASK,), (owns(fleet, who, TASK),))) for who in "bc"]
    if ends == "its link":
        for who, _ in made:
            fleet.crash(who)
        fleet.run_for(0.5)
    else:
        monkeypatch.setattr(a.kernel.access, "fault", lambda peer, *of: "it may not" if peer in "bc" else "")
    for who, known in made:
        assert a.kernel.tell("client", KnownCame(who, known))
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "old copy"), "both knew of a later owner"


def test_what_waits_looks_at_each_task_a_few_times_a_second(fleet: Fleet, monkeypatch: pytest.MonkeyPatch):
    for number in range(18):
        monkeypatch.setitem(TASKS, f"Sink{number}", Sink)
    a = silent(fleet)
    looks: list[Epoch] = []

    def counted(epoch: Epoch, *others: Any) -> Finding:
        looks.append(epoch)
        return copied_task(epoch, *others)

    monkeypatch.setattr(questions, "copied_task", counted)
    fleet.run_for(3.0)
    assert state(a, "Sink0") == ("stopped", "old copy")
    assert 0 < len(looks) <= 3 * 20 * 5


def test_a_person_has_one_of_them_go_on(fleet: Fleet):
    a = silent(fleet)
    assert a.ask(Adopt("Sink", dry_run=True)).ok and state(a) == ("stopped", "old copy")
    assert a.ask(Adopt("Sink")).ok
    fleet.run_for(0.5)
    assert state(a)[0] == "running" and state(a, "Other") == ("stopped", "old copy")


def test_a_persons_word_outdoes_an_owner_that_another_person_has_made(fleet: Fleet):
    """The task waits for b and c, and d owns it under an epoch that a person has raised."""
    a = silent(fleet)
    fleet.start("d")
    fleet.connect()
    theirs = owns(fleet, "d", TASK, MORE_THAN_MIGRATIONS + 500)
    tell(fleet, "d", "a", theirs)
    fleet.run_for(0.5)
    assert state(a) == ("stopped", "disputed")
    assert a.ask(Adopt("Sink")).ok
    tell(fleet, "d", "a", theirs)
    fleet.run_for(0.5)
    assert state(a)[0] == "running"


# Forged messages ---------------------------------------------------------------------------------------------------

TASK = TaskId("a", "Sink")
ALLOWED = """
[[access.allow]]
who = ["role:agent"]
may = ["look", "publish"]
"""


def lies(fleet: Fleet, who: str, number: int = 99, journal: str = "") -> None:
    journal = journal or fleet.agents["a"].agent.mesh.identity.journal
    fleet.agents[who].publish(NETWORK, BootRemembered(journal, number, "made up"), to=f"a/{REGISTRAR}")
    fleet.run_for(0.5)


@pytest.mark.parametrize("right", ["host", "guard", ""])
def test_that_a_disk_is_an_old_copy_is_believed_only_of_two_that_may_host_or_guard(fleet: Fleet, right: str):
    rights = ALLOWED.replace('"publish"', f'"publish", "{right}"') if right else ALLOWED
    begun(fleet, "bc", rights)
    a = fleet.agents["a"]
    lies(fleet, "b")
    lies(fleet, "b")
    assert a.events("task_stopped") == [], "one alone says it as often as it likes"
    lies(fleet, "c")
    fleet.run_for(1.0)
    assert len(a.events("task_stopped")) == (2 if right else 0)
    assert sorted(a.running("client")) == ["Other", "Sink"], "and then they tell that they know of no other owner"


def test_a_lie_about_another_journal_or_an_earlier_start_says_nothing(fleet: Fleet):
    begun(fleet, "bc")
    for who in "bc":
        lies(fleet, who, journal="another disk")
        lies(fleet, who, number=1)
    assert fleet.agents["a"].lines("warning") == [] and fleet.agents["a"].events("old_copy") == []


def test_a_simulated_world_says_nothing_of_disks(fleet: Fleet):
    begun(fleet, "b")
    for name in "vw":
        fleet.start(name, role="environment")
    fleet.connect()
    for name in "vw":
        lies(fleet, name)
    assert fleet.agents["a"].lines("warning") == [] and fleet.agents["a"].events("old_copy") == []


def forges(fleet: Fleet, who: str) -> None:
    """An agent says that z owns a task."""
    known = replace(owns(fleet, who, TASK), register=Register(Epoch(9, Identity("z", "made up"))))
    tell(fleet, who, "a", known, task_ids=(TASK,))


def test_that_a_task_went_on_elsewhere_is_believed_only_of_those_that_take_the_disk_for_a_copy(fleet: Fleet):
    begun(fleet, "bcd")
    a = fleet.agents["a"]
    for who in "bc":
        lies(fleet, who)
    forges(fleet, "d")
    fleet.run_for(1.0)
    assert state(a)[0] == "running" and a.events("task_disputed") == []


def test_what_one_of_them_knows_counts_once_there_are_two(fleet: Fleet):
    begun(fleet, "bc")
    a = fleet.agents["a"]
    lies(fleet, "b")
    forges(fleet, "b")
    fleet.run_for(0.5)
    assert state(a)[0] == "running" and a.events("task_disputed") == [], "b is alone"
    lies(fleet, "c")
    assert state(a) == ("stopped", "disputed") and state(a, "Other")[0] == "running"


def test_an_agent_that_bears_the_journal_of_another_changes_nothing_of_what_is_remembered_of_that_one(
    fleet: Fleet,
):
    """Its boot number may be as high as it likes: what is remembered goes by the name of an agent too."""
    begun(fleet, "bc")
    put(fleet, "x", {file: data for file, data in copy_of(fleet, "a").items() if file.startswith("identity")})
    for _ in range(3):
        fleet.start("x")
        fleet.connect()
        fleet.run_for(0.5)
        fleet.crash("x")
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.run_until(lambda: len(a.agent.mesh.connected()) == 2)
    fleet.run_for(1.0)
    assert a.events("old_copy") == [] and a.lines("warning") == []
