"""A task that is new on its birthplace is born once the other agents have said that they know nothing of it."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from services.numbered import Sink
from services.strangers import identity, owns, say, tell

from pancakes.control import Adopt, Describe, Forget, Migrate, Restart, Start, Stop
from pancakes.durable.answers import Answers
from pancakes.durable.messages import Accept, Fact, Known, Prepare, WhoHas
from pancakes.durable.record import TaskId
from pancakes.durable.register import NO_EPOCH, Epoch, Identity, Register
from pancakes.durable.rules import NO_WRITE
from pancakes.testing import AgentHandle, Fleet

SINK = {"Sink": Sink}
GUARDED = {"Sink": {"type": Sink, "guard": {"copies": 3}}}
TASK = TaskId("a", "Sink")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=7) as made:
        yield made


def start(fleet: Fleet, name: str, peers: str = "", text: str = "", **others: Any) -> AgentHandle:
    """Starts an agent that asks those of `peers`, one letter each, before it gives birth."""
    addresses = tuple(f"tcp://{peer}:7400" for peer in peers)
    return fleet.start(name, text, peers=addresses, **{"birth_wait_s": 10.0, "classes": {"Sink": Sink}, **others})


def state(agent: AgentHandle, task: str = "Sink") -> tuple[str, str]:
    found = agent.ask(Describe(target=task)).result
    return found["state"], found["rest"]


def moved(fleet: Fleet, tasks: dict[str, Any] = SINK) -> None:
    """The task was born on a and runs on b, and a has crashed."""
    start(fleet, "a", tasks=tasks)
    start(fleet, "b", "a")
    fleet.connect()
    assert fleet.agents["a"].ask(Migrate("Sink", to="b")).ok
    fleet.run_for(2.0)
    assert state(fleet.agents["b"])[0] == "running"
    fleet.crash("a")


def test_when_a_whole_fleet_starts_for_the_first_time_all_is_born_at_once_and_nothing_is_said(fleet: Fleet):
    for name, others in (("a", "bc"), ("b", "ac"), ("c", "ab")):
        start(fleet, name, others, tasks={"Sink": Sink, "Other": Sink}, settle=False)
    agents = list(fleet.agents.values())
    assert fleet.run_until(lambda: all(len(agent.running("client")) == 2 for agent in agents), 0.5)
    fleet.run_for(11.0)
    assert [line for agent in agents for line in agent.lines("warning") + agent.lines("error")] == []
    assert [event for agent in agents for event in agent.events("birth_waits")] == []


def test_an_agent_is_ready_while_its_tasks_wait(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=SINK)
    assert a.agent.ready.is_set() and state(a) == ("stopped", "waits → tcp://b:7400")


def test_without_peers_it_is_born_at_once(fleet: Fleet):
    assert start(fleet, "a", tasks=SINK).running("client") == ["Sink"]
    assert start(fleet, "b", "c", tasks=SINK, birth_wait_s=0.0).running("client") == ["Sink"]


def test_an_agent_that_has_a_record_of_it_waits_for_none(fleet: Fleet):
    start(fleet, "a", tasks=SINK)
    fleet.run_for(0.5)
    fleet.crash("a")
    assert start(fleet, "a", "bc", tasks=SINK).running("client") == ["Sink"]


def test_a_simulated_world_among_the_peers_is_met_and_not_asked(fleet: Fleet):
    fleet.start("w", role="environment")
    a = start(fleet, "a", "w", tasks=SINK)
    assert fleet.run_until(lambda: a.running("client") == ["Sink"], 2.0)


def test_where_an_agent_is_missing_it_says_so_and_the_task_begins_later_with_a_warning(fleet: Fleet):
    start(fleet, "b")
    a = start(fleet, "a", "bc", tasks={"Sink": Sink, "Other": Sink})
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "waits → tcp://c:7400")
    described = a.ask(Describe(target="Sink")).result
    assert (
        "a/Sink is new here, and may run elsewhere: it waits to hear from tcp://c:7400, for 10 s at"
        in described["reason"]
    )
    (told,) = a.events("birth_waits")
    assert (told["tasks"], told["missing"]) == ("Other, Sink", "tcp://c:7400")
    assert sum("Other, Sink" in line for line in a.lines("warning")) == 1 and a.lines("error") == []
    fleet.run_for(9.0)
    assert sorted(a.running("client")) == ["Other", "Sink"]
    unasked = sorted((it["task"], it["missing"]) for it in a.events("born_unasked"))
    assert unasked == [("Other", "tcp://c:7400"), ("Sink", "tcp://c:7400")]


class Drive(Sink):
    requires = ("motors",)


def test_a_task_that_lacks_a_device_when_the_wait_is_over_begins_once_that_is_there(fleet: Fleet):
    a = start(fleet, "a", "b", tasks={"Drive": Drive}, devices={"wheels": "null.motors"}, classes={"Drive": Drive})
    assert a.ask(Stop("device/wheels")).ok
    fleet.run_for(15.0)
    assert state(a, "Drive")[0] == "stopped"
    assert a.ask(Start("device/wheels")).ok
    assert fleet.run_until(lambda: a.running("client") == ["Drive"], 3.0)
    (unasked,) = a.events("born_unasked")
    assert (unasked["task"], unasked["missing"]) == ("Drive", "tcp://b:7400")


def test_an_agent_that_comes_late_is_asked_then(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=SINK)
    fleet.run_for(3.0)
    start(fleet, "b", "a")
    assert fleet.run_until(lambda: a.running("client") == ["Sink"], 1.0)
    assert a.events("born_unasked") == []


def test_a_question_that_was_lost_is_asked_again(fleet: Fleet, monkeypatch: pytest.MonkeyPatch):
    ask, lost = Answers.ask, list[Any]()

    def loses_the_first(*asked: Any) -> None:
        if lost:
            ask(*asked)
        lost.append(asked)

    monkeypatch.setattr(Answers, "ask", loses_the_first)
    start(fleet, "b", "a")
    a = start(fleet, "a", "b", tasks=SINK)
    assert fleet.run_until(lambda: a.running("client") == ["Sink"], 3.0) and lost
    assert a.events("born_unasked") == []


def test_what_is_asked_for_expressly_begins_at_once(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=SINK)
    assert a.ask(Start("Sink", dry_run=True)).ok and a.running("client") == []
    assert a.ask(Start("Sink")).ok and a.running("client") == ["Sink"]
    assert [it["missing"] for it in a.events("born_unasked")] == ["tcp://b:7400"]


def test_one_that_is_stopped_while_it_waits_stays_stopped(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=SINK)
    assert a.ask(Stop("Sink")).ok
    fleet.run_for(12.0)
    assert a.running("client") == []


def test_a_birthplace_with_an_empty_disk_gives_no_birth_to_what_runs_elsewhere(fleet: Fleet):
    moved(fleet)
    fleet.disk("a").clear()
    a = start(fleet, "a", "b", tasks=SINK)
    fleet.run_for(12.0)
    assert a.running("client") == [] and state(fleet.agents["b"])[0] == "running"
    refused = a.ask(Start("Sink"))
    assert not refused.ok and "b owns a/Sink (epoch 1@b)" in refused.reason
    assert state(a) == ("stopped", "disk lost") and [it["owner"] for it in a.events("not_born")] == ["b"]
    assert a.events("task_disputed") == [] and fleet.agents["b"].events("task_disputed") == []
    assert fleet.agents["b"].ask(Migrate("Sink", to="a")).ok
    fleet.run_for(2.0)
    assert state(a) == ("running", "")


def test_also_one_that_passed_it_on_knows_that_it_was_born(fleet: Fleet):
    moved(fleet)
    start(fleet, "c", "b")
    fleet.connect()
    assert fleet.agents["b"].ask(Migrate("Sink", to="c")).ok
    fleet.run_for(2.0)
    fleet.crash("c")
    fleet.disk("a").clear()
    a = start(fleet, "a", "b", tasks=SINK)
    fleet.run_for(12.0)
    assert state(a) == ("stopped", "disk lost")
    (told,) = a.events("not_born")
    assert (told["task"], told["owner"], told["epoch"]) == ("Sink", "c", 2)
    assert sum("a/Sink was born before (c has it, epoch 2@c)" in line for line in a.lines("error")) == 1
    assert "was born before" in a.ask(Start("Sink")).reason


def test_a_person_decides_about_one_that_was_born_before(fleet: Fleet):
    test_also_one_that_passed_it_on_knows_that_it_was_born(fleet)
    a = fleet.agents["a"]
    assert a.ask(Adopt("Sink")).ok
    fleet.run_for(1.0)
    assert state(a) == ("running", "")
    c = fleet.restart("c")
    fleet.connect()
    fleet.run_for(1.0)
    assert state(c) == ("stopped", "disputed"), "its epoch is the lower one"


def test_forgotten_it_rests_for_good(fleet: Fleet):
    test_also_one_that_passed_it_on_knows_that_it_was_born(fleet)
    assert fleet.agents["a"].ask(Forget("Sink")).ok
    fleet.crash("a")
    a = start(fleet, "a", tasks=SINK)
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "forgotten")


def test_what_was_moved_before_its_agent_was_renamed_is_not_born_under_the_new_name(fleet: Fleet):
    moved(fleet)
    disk = {name: data for name, data in fleet.disk("a").items() if name != "lock"}
    fleet.disk("r").update(disk)
    r = start(fleet, "r", "b", tasks=SINK)
    fleet.run_for(12.0)
    assert state(r) == ("stopped", "disk lost")
    assert any("a/Sink was born before (b has it, epoch 1@b), and r knows nothing of r/Sink" in it for it in r.lines())


def test_an_old_disk_under_a_new_name_asks_about_both_names(fleet: Fleet):
    start(fleet, "a")
    fleet.run_for(0.5)
    disk = {name: data for name, data in fleet.disk("a").items() if name != "lock"}
    fleet.crash("a")
    fleet.disk("a").clear()
    moved(fleet)
    fleet.disk("r").update(disk)
    r = start(fleet, "r", "b", tasks=SINK)
    fleet.run_for(12.0)
    assert state(r) == ("stopped", "disk lost"), "it went from another disk, which had that name"


# Guarded tasks -----------------------------------------------------------------------------------------------------


def test_a_guarded_task_waits_on_until_a_person_decides(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=GUARDED)
    fleet.run_for(30.0)
    assert state(a) == ("stopped", "waits → tcp://b:7400")
    refused = a.ask(Start("Sink"))
    assert not refused.ok and "pancakes task recover a/Sink --here" in refused.reason
    assert len(a.events("birth_waits")) == 2
    assert a.ask(Adopt("Sink")).ok
    fleet.run_for(2.0)
    assert state(a)[0] == "running"


def test_a_guarded_task_is_born_once_most_of_its_guardians_know_nothing_of_it(fleet: Fleet):
    start(fleet, "b")
    guarded = {"Sink": {"type": Sink, "guard": {"copies": 3, "guardians": ("b", "a")}}}
    a = start(fleet, "a", "bc", tasks=guarded)
    fleet.run_for(9.0)
    assert state(a) == ("stopped", "waits → tcp://c:7400")
    fleet.run_for(3.0)
    assert state(a)[0] == "running" and [it["missing"] for it in a.events("born_unasked")] == ["tcp://c:7400"]


def test_a_guardian_knows_of_its_task(fleet: Fleet):
    start(fleet, "b")
    start(fleet, "c", "b")
    a = start(fleet, "a", "bc", tasks=GUARDED)
    fleet.run_for(5.0)
    assert state(a)[0] == "running"
    fleet.crash("a")
    fleet.disk("a").clear()
    a = start(fleet, "a", "bc", tasks=GUARDED)
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "disk lost"), "its lease runs, and it is not born a second time"
    fleet.run_for(20.0)
    assert sum("Sink" in agent.running("client") for agent in fleet.agents.values()) == 1


# Forged messages ---------------------------------------------------------------------------------------------------

ALLOWED = """
[[access.allow]]
who = ["role:agent"]
may = ["look", "publish"]
"""


def says(fleet: Fleet, who: str, *facts: Fact, task_ids: tuple[TaskId, ...] = (TASK,)) -> None:
    tell(fleet, who, "a", *facts, task_ids=task_ids)
    fleet.run_for(0.2)


@pytest.mark.parametrize("right", ["host", ""])
def test_an_agent_that_says_it_is_at_the_address_of_another_is_believed_as_far_as_it_may_host(
    fleet: Fleet, right: str
) -> None:
    rights = ALLOWED.replace('"publish"', f'"publish", "{right}"') if right else ALLOWED
    a = start(fleet, "a", "b", rights, tasks=SINK)
    fleet.run_for(1.0)
    start(fleet, "x", "a", listen="tcp://b:7400")
    fleet.run_for(0.3)
    assert a.running("client") == (["Sink"] if right else [])


@pytest.mark.parametrize("right", ["host", "guard", ""])
def test_that_a_task_was_born_is_believed_only_of_an_agent_that_may_host_or_guard_it(fleet: Fleet, right: str):
    rights = ALLOWED.replace('"publish"', f'"publish", "{right}"') if right else ALLOWED
    start(fleet, "x")
    a = start(fleet, "a", "xb", rights, tasks=SINK)
    fleet.run_for(1.0)
    says(fleet, "x", owns(fleet, "x", TASK))
    fleet.run_for(12.0)
    assert a.running("client") == ([] if right else ["Sink"])
    refused = any("x says that it knows a/Sink, and is not believed: a does not" in it for it in a.lines())
    assert refused == (not right)


def test_an_agent_answers_for_itself_alone(fleet: Fleet):
    a = start(fleet, "a", "b", tasks=SINK)
    for name in "xy":
        start(fleet, name, "a")
    fleet.run_for(1.0)
    says(fleet, "x")
    says(fleet, "y")
    assert state(a) == ("stopped", "waits → tcp://b:7400")


def test_what_was_told_of_a_task_is_forgotten_once_it_is_born(fleet: Fleet):
    """Else each agent that ever answers leaves something, and what it said counts when the task is born again."""
    start(fleet, "x")
    a = start(fleet, "a", "x", tasks=SINK)
    fleet.run_for(1.0)
    assert a.running("client") == ["Sink"]
    owner = Identity("late")  # a name that no other test of this process has
    says(fleet, "x", Fact(TASK, Register(Epoch(0, owner), sets=((owner,),))))
    fleet.run_for(1.0)
    gc.collect()
    assert not [it for it in gc.get_objects() if isinstance(it, Fact) and it.owner == "late"]


def test_an_answer_about_a_task_that_was_not_asked_about_says_nothing(fleet: Fleet):
    start(fleet, "x")
    a = start(fleet, "a", "xb", tasks=SINK)
    fleet.run_for(1.0)
    says(fleet, "x", owns(fleet, "x", TASK), task_ids=(TaskId("a", "Other"),))
    says(fleet, "x", owns(fleet, "x", TaskId("a", "Other")))
    assert state(a) == ("stopped", "waits → tcp://b:7400")


def test_a_simulated_world_knows_of_no_task(fleet: Fleet):
    fleet.start("w", role="environment")
    a = start(fleet, "a", "wb", tasks=SINK)
    fleet.run_for(1.0)
    says(fleet, "w", owns(fleet, "w", TASK))
    assert state(a) == ("stopped", "waits → tcp://b:7400")


def test_an_agent_that_asks_is_answered_once(fleet: Fleet):
    start(fleet, "a", tasks=SINK)
    x = fleet.start("x")
    fleet.connect()
    fleet.run_for(0.5)
    (before,) = [link["packets_in"] for link in x.agent.mesh.links() if link["name"] == "a"]
    say(fleet, "x", WhoHas((TASK, TaskId("a", "Other"))), "a")
    fleet.run_for(0.5)
    (after,) = [link["packets_in"] for link in x.agent.mesh.links() if link["name"] == "a"]
    assert after - before == 1


def test_a_service_that_begins_again_is_told_what_an_agent_owns_with_each_of_its_disks(fleet: Fleet) -> None:
    a = start(fleet, "a", tasks={"Sink": {"type": Sink, "start": False}})
    start(fleet, "x", "a")
    fleet.connect()
    fleet.run_for(0.5)
    other, before = TaskId("x", "Other"), Identity("x", "its disk before")
    say(fleet, "x", Known(before, (), (Fact(other, Register(Epoch(3, before), sets=((before,),))),)), "a")
    says(fleet, "x", owns(fleet, "x", TASK))
    assert a.ask(Restart("client")).ok
    fleet.run_for(0.5)
    refused = a.ask(Start("Sink"))
    assert not refused.ok and "x owns a/Sink" in refused.reason


@pytest.mark.parametrize("how", ["asks for a promise", "names it a member"])
def test_a_stranger_that_claims_a_task_keeps_it_from_no_birth(fleet: Fleet, how: str):
    """The configuration does not start it yet, and this agent knows nothing of it."""
    a = start(fleet, "a", tasks={"Sink": {"type": Sink, "start": False}})
    for name in "xy":
        start(fleet, name, "a")
    fleet.connect()
    fleet.run_for(0.5)
    x, me = identity(fleet, "x"), identity(fleet, "a")
    epoch = Epoch(9, x)
    kind = a.slot("Sink").spec.type
    if how == "asks for a promise":
        say(fleet, "x", Prepare(TASK, kind, epoch, (NO_EPOCH, NO_WRITE), ((me,),)), "a")
    else:
        say(fleet, "x", Accept(TASK, kind, "client", Register(epoch, 1, ((x, me),)), state=b"x"), "a")
    fleet.run_for(1.0)
    assert a.ask(Start("Sink")).ok
    assert a.running("client") == ["Sink"]


class Drives(Sink):
    requires = ("motors",)


def test_actuators_are_kept_for_a_task_that_waits(fleet: Fleet):
    wheels = {"motors": "null.motors"}
    b = start(fleet, "b", devices=wheels, tasks={"Other": Drives})
    a = start(fleet, "a", "bc", devices=wheels, tasks={"Sink": Drives}, birth_wait_s=60.0)
    fleet.connect()
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "waits → tcp://c:7400")
    reply = b.ask(Migrate("Other", to="a"))
    assert not reply.ok and "motors is kept for a/client/Sink" in reply.reason, reply.reason
    assert a.ask(Stop("Sink")).ok
    reply = b.ask(Migrate("Other", to="a"))
    assert reply.ok, reply.reason
