"""The team's allocation on agents: when rounds begin, what they migrate, and what goes wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from pancakes.client.rows import sentence_of
from pancakes.control import Allocate, Describe, Migrate, Migrations, Stop
from pancakes.devices import Battery, Reserve
from pancakes.durable.allocator import MOST_ASKED
from pancakes.durable.bidding import Appraise, Appraiser
from pancakes.durable.market import MOST_NUMBER, Row
from pancakes.durable.messages import Solicit
from pancakes.kernel.mailbox import tell
from pancakes.migration import Cost, CostFacts
from pancakes.task import Task
from pancakes.testing import AgentHandle, Fleet
from pancakes.tools.cli.verbs.agent_checks import check_allocation
from pancakes.tools.cli.verbs.checks import Facts

RULE = {"when": "allocation", "move_price": 0.5}


class Work(Task):
    pass


class Reach(Task):
    requires = ("battery",)


class Far(Cost):
    """How far it is to the task, as the settings of this agent's tasks would say; here by the battery that it has."""

    name = "test.far"
    reads = ("battery",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        return {"metres": facts.reading("battery").voltage_v}


def part(at_most: int = 3, crowding: float = 1.0) -> dict[str, Any]:
    return {"network": {"settings": {"allocation": {"at_most": at_most, "crowding": crowding}}}}


def work(count: int, type: type[Task] = Work, **rule: Any) -> dict[str, Any]:
    return {f"W{number}": {"type": type, "migrate": {**RULE, **rule}} for number in range(count)}


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(4, classes={"test.Work": Work, "test.Reach": Reach, "test.far": Far}) as made:
        yield made


@pytest.fixture
def lossy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the faults of a fleet lose also what agents coordinate with."""
    monkeypatch.setattr("pancakes.simulation.fleet.NEVER_LOST", ())


def spread(fleet: Fleet) -> dict[str, int]:
    return {name: len(agent.running()) for name, agent in fleet.agents.items()}


def place(fleet: Fleet, task: str) -> list[str]:
    return [name for name, agent in fleet.agents.items() if task in agent.running()]


def accounts(agent: AgentHandle) -> list[Mapping[str, Any]]:
    return [event for event in agent.events("allocation") if not event["dry_run"]]


def test_the_team_spreads_its_tasks_by_the_ordinary_migration_and_then_rests(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(), tasks=work(6))
    fleet.start("b", services=part())
    fleet.start("c", services=part())
    fleet.connect()
    assert fleet.run_until(lambda: spread(fleet) == {"a": 2, "b": 2, "c": 2}, 20.0)
    fleet.run_for(1.0)
    assert {row["asked_by"] for row in a.ask(Migrations()).result} == {"a/network/Allocator"}
    before = [len(accounts(agent)) for agent in fleet.agents.values()]
    fleet.run_for(30.0)
    moved = sum(len(agent.ask(Migrations()).result) for agent in fleet.agents.values())
    after = [len(accounts(agent)) for agent in fleet.agents.values()]
    assert moved == 4 and sum(after) - sum(before) <= 3  # a round for what the moves have changed, and no more


def test_a_dry_run_tells_what_each_bids_and_moves_nothing(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(1), tasks=work(2))
    fleet.start("b", services=part())
    fleet.start("plain")
    fleet.connect()
    told = a.ask(Allocate(dry_run=True)).result
    rows = {line["task"]: line for line in told["lines"]}
    assert rows["a/W0"]["bids"] == {"a": 100.0, "b": 99.5}
    assert [rows[it]["winner"] for it in ("a/W0", "a/W1")] == ["a", "b"]
    assert (told["value"], told["present"], told["dry_run"]) == (199.5, 199.0, True)
    assert list(told["silent"]) == ["plain"]
    assert place(fleet, "W1") == ["a"]
    (event,) = [it for it in a.events("allocation") if it["dry_run"]]
    told = sentence_of({**event, "kind": "allocation", "agent": "a", "gap": 0.021})
    assert told.endswith("begun by a: would migrate W1 to b; 2.1% below the best allocation")


def test_an_agent_that_takes_no_part_refuses_a_round_with_what_to_write(fleet: Fleet) -> None:
    reply = fleet.start("a").ask(Allocate())
    assert reply.refusal is not None and reply.refusal.code == "unsupported" and "[service.network]" in reply.reason


def test_a_battery_that_falls_begins_a_round_and_the_fuller_agent_gets_the_task(fleet: Fleet) -> None:
    cells = {"battery": "null.battery"}
    rule = {"cost": {"battery": 100.0}, "move_price": 10.0}
    a = fleet.start("a", services=part(), devices=cells, tasks=work(1, Reach, **rule))
    b = fleet.start("b", services=part(), devices=cells)
    fleet.connect()
    for agent in (a, b):
        agent.publish("system", Battery(12.0, 0.9))
    fleet.run_for(10.0)
    assert place(fleet, "W0") == ["a"]
    a.publish("system", Battery(12.0, 0.85))  # less than the price of a move
    fleet.run_for(10.0)
    assert place(fleet, "W0") == ["a"]
    a.publish("system", Battery(12.0, 0.3))
    assert fleet.run_until(lambda: place(fleet, "W0") == ["b"], 15.0)


def test_a_cost_function_of_a_plug_in_counts_and_one_that_fails_is_a_refusal(fleet: Fleet) -> None:
    cells = {"battery": "null.battery"}
    a = fleet.start("a", services=part(), devices=cells, tasks=work(1, Reach, cost="test.far"))
    b = fleet.start("b", services=part(), devices=cells)
    fleet.start("c", services=part(), devices=cells)
    fleet.connect()
    a.publish("system", Battery(30.0, 1.0))
    b.publish("system", Battery(2.0, 1.0))
    (line,) = a.ask(Allocate(dry_run=True)).result["lines"]
    assert line["bids"] == {"a": 70.0, "b": 97.5} and line["winner"] == "b"
    assert "has not been read yet" in line["refusals"]["c"]


def test_an_agent_that_cannot_do_a_task_does_not_get_it(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(0), devices={"battery": "null.battery"}, tasks=work(1, Reach))
    fleet.start("b", services=part())
    fleet.connect()
    (line,) = a.ask(Allocate(dry_run=True)).result["lines"]
    assert line["winner"] == "" and "lacks the device type battery" in line["refusals"]["b"]
    fleet.run_for(10.0)
    assert len(unplaced(a)) == 1, "nor is there a place on a"
    assert place(fleet, "W0") == ["a"]


def test_more_tasks_than_places_stay_where_they_are(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(1), tasks=work(4))
    fleet.start("b", services=part(1))
    fleet.connect()
    assert fleet.run_until(lambda: spread(fleet) == {"a": 3, "b": 1}, 20.0)
    reason = "no agent that can take it has a place left"
    lines = a.ask(Allocate(dry_run=True)).result["lines"]
    assert sorted(line["reason"] for line in lines)[-2:] == [reason] * 2
    assert fleet.run_until(lambda: len(unplaced(a)) == 2, 20.0)
    assert all(text.endswith(f", and the allocation finds no robot for it: {reason}") for text in unplaced(a))
    fleet.start("c", services=part(2))
    fleet.connect()
    assert fleet.run_until(lambda: unplaced(a) == [], 20.0)


def test_a_task_that_a_person_moves_to_an_agent_that_takes_no_part_is_named(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(), tasks=work(1))
    b = fleet.start("b")
    fleet.connect()
    assert unplaced(b) == []
    assert a.ask(Migrate("client/W0", "b")).refusal is None
    (text,) = unplaced(b)
    assert text.startswith("has a/W0, and the allocation finds no robot for it: b takes no part in the allocation")
    assert "[service.network]" in text and unplaced(a) == []


def unplaced(agent: AgentHandle) -> list[str]:
    """Return what doctor says of the agent's tasks that are not allocated."""
    return [found.text for found in check_allocation(agent.ask(Describe()).result, Facts())]


def test_an_agent_that_tells_nonsense_is_left_out_and_named(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(1), tasks=work(2))
    fleet.start("b", services=part())
    liar = fleet.start("liar")
    fleet.connect()
    fleet.run_for(0.5)

    asked = a.publish("sysctrl", Allocate(dry_run=True))
    fleet.run_for(0.2)
    row = Row(1, "a", True, 1, 5, 0.0, {}, {"a/W0": math.nan, "a/W1": 0.0}, {}, ("a/W0", "a/W1"))
    liar.publish("network", row, to="a/network/Allocator")
    told = a.reply_to(asked).result
    assert told["ignored"] == {"liar": "its cost of a/W0 is nan"}
    assert {line["winner"] for line in told["lines"]} == {"a", "b"}


def test_a_winner_that_does_not_take_the_task_does_not_get_it_for_a_while(fleet: Fleet, lossy: None) -> None:
    a = fleet.start("a", services=part(1), tasks=work(2, again_s=20.0))
    b = fleet.start("b", services=part())
    fleet.connect()
    # It bids in rounds, and never answers when it is to take what it has won.
    fleet.faults.lose(1.0, Solicit, at="b")
    assert fleet.run_until(lambda: any("does not get it for 20 s" in it for it in a.lines("warning")), 20.0)
    fleet.run_for(8.0)
    lines = accounts(a)[-1]["lines"]
    assert any(line["refusals"].get("b") == "it has just refused the task" for line in lines)
    fleet.faults.calm()
    assert fleet.run_until(lambda: len(b.running()) == 1, 40.0)


def test_a_task_that_comes_later_and_one_whose_agent_has_died_are_allocated(fleet: Fleet) -> None:
    guard = {"copies": 3, "lease_s": 2.0}
    tasks = {name: {**table, "guard": guard} for name, table in work(3, move_price=0.25).items()}
    fleet.start("a", services=part(1), tasks=tasks)
    for name in ("b", "c", "d"):
        fleet.start(name, services=part(2))
    fleet.connect()
    assert fleet.run_until(lambda: spread(fleet)["a"] == 1 and sum(spread(fleet).values()) == 3, 30.0)
    (lost,) = fleet.agents["a"].running()
    fleet.crash("a")
    assert fleet.run_until(lambda: place(fleet, lost) != [], 10.0)
    fleet.run_for(20.0)
    assert sum(spread(fleet).values()) == 3 and max(spread(fleet).values()) == 1


def test_a_stopped_task_is_not_put_up(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(), tasks=work(2))
    a.ask(Stop("W0"))
    assert [line["task"] for line in a.ask(Allocate(dry_run=True)).result["lines"]] == ["a/W1"]


def test_a_round_ends_as_well_if_a_fifth_of_its_packets_is_lost(fleet: Fleet, lossy: None) -> None:
    fleet.start("a", services=part(), tasks=work(6))
    fleet.start("b", services=part())
    fleet.start("c", services=part())
    fleet.connect()
    fleet.faults.lose(0.2, Row)
    assert fleet.run_until(lambda: spread(fleet) == {"a": 2, "b": 2, "c": 2}, 30.0)


def test_a_cost_of_a_plug_in_that_changes_begins_a_round(fleet: Fleet) -> None:
    cells = {"battery": "null.battery"}
    a = fleet.start("a", services=part(), devices=cells, tasks=work(1, Reach, cost="test.far"))
    b = fleet.start("b", services=part(), devices=cells)
    fleet.connect()
    a.publish("system", Battery(5.0, 1.0))
    b.publish("system", Battery(30.0, 1.0))
    fleet.run_for(20.0)
    assert place(fleet, "W0") == ["a"]
    b.publish("system", Battery(1.0, 1.0))  # it is nearer now
    assert fleet.run_until(lambda: place(fleet, "W0") == ["b"], 20.0)


def test_a_round_of_the_highest_number_ends_no_later_rounds(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(1), tasks=work(2))
    fleet.start("b", services=part())
    liar = fleet.start("liar")
    fleet.connect()
    for to in ("a", "b"):
        liar.publish("network", Row(MOST_NUMBER, "liar", seq=1), to=f"{to}/network/Allocator")
    fleet.run_for(20.0)
    for _ in range(3):
        assert a.ask(Allocate(dry_run=True)).ok
    assert spread(fleet) == {"a": 1, "b": 1, "liar": 0}


def test_a_late_packet_of_a_round_that_is_over_begins_none(fleet: Fleet) -> None:
    a = fleet.start("a", services=part())
    late = fleet.start("late")
    fleet.connect()
    first = a.ask(Allocate()).result["number"]
    a.ask(Allocate())
    fleet.run_for(20.0)
    before = len(accounts(a))
    late.publish("network", Row(first, "a", seq=1, asks=True), to="a/network/Allocator")
    fleet.run_for(20.0)
    assert len(accounts(a)) == before


def test_requests_for_rounds_that_come_together_are_all_answered(fleet: Fleet) -> None:
    a = fleet.start("a", services=part(), tasks=work(2))
    b = fleet.start("b", services=part())
    fleet.connect()
    asked = [(agent, agent.publish("sysctrl", Allocate(dry_run=True))) for agent in (a, b, a)]
    assert [agent.reply_to(packet).result["starter"] for agent, packet in asked] == ["a", "b", "a"]


def test_each_migration_makes_the_next_one_dearer_for_a_while(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancakes.durable.allocator.SETTLED_S", 100.0)
    cells = {"battery": "null.battery"}
    rule = {"cost": "test.far", "move_price": 4.0}
    a = fleet.start("a", services=part(), devices=cells, tasks=work(1, Reach, **rule))
    b = fleet.start("b", services=part(), devices=cells)
    fleet.connect()
    a.publish("system", Battery(10.0, 1.0))
    b.publish("system", Battery(5.0, 1.0))
    assert fleet.run_until(lambda: place(fleet, "W0") == ["b"], 20.0)
    a.publish("system", Battery(0.0, 1.0))  # five better, and the price is eight now
    fleet.run_for(60.0)
    assert place(fleet, "W0") == ["b"]
    fleet.run_for(60.0)
    b.publish("system", Battery(5.5, 1.0))
    a.ask(Allocate())
    assert fleet.run_until(lambda: place(fleet, "W0") == ["a"], 20.0)


def test_an_agent_whose_reserve_is_old_makes_no_bid_by_it(fleet: Fleet) -> None:
    cells = {"battery": "null.battery"}
    a = fleet.start("a", services=part(0), devices=cells, tasks=work(1, Reach, cost="reserve"))
    b = fleet.start("b", services=part(), devices=cells)
    fleet.connect()
    for agent in (a, b):
        agent.publish("system", Battery(12.0, 0.9))
    a.publish("system", Reserve(30.0, 0.1))
    b.publish("system", Reserve(600.0, 0.5))
    (line,) = a.ask(Allocate(dry_run=True)).result["lines"]
    assert line["bids"] == {"a": 98.0, "b": 99.4} and line["winner"] == "b"
    fleet.run_for(61.0)
    (line,) = b.ask(Allocate(dry_run=True)).result["lines"]
    assert line["refusals"]["b"] == "cannot tell its cost: its reserve has not been read yet"


@dataclass
class Many:
    names: list[str] = field(default_factory=list)


class Heavy(Task):
    requires = ("battery",)
    Settings = Many
    settings: Many


def test_a_task_that_says_too_much_for_a_bid_is_named_once_and_the_others_are_allocated(fleet: Fleet) -> None:
    heavy = {
        "Heavy": {"type": Heavy, "migrate": {**RULE, "cost": "test.far"}, "settings": {"names": ["x" * 99] * 2000}}
    }
    cells = {"battery": "null.battery"}
    a = fleet.start("a", services=part(), devices=cells, tasks={**work(1), **heavy}, classes={"test.Heavy": Heavy})
    fleet.run_for(10.0)
    assert [line["task"] for line in a.ask(Allocate(dry_run=True)).result["lines"]] == ["a/W0"]
    assert sum("a/Heavy is not allocated" in it for it in a.lines("warning")) == 1


def test_an_agent_with_more_tasks_than_a_team_allocates_says_so_once(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pancakes.durable.allocator.MOST_LOTS", 2)
    agent = fleet.start("a", tasks=work(5), services=part())
    fleet.run_for(3.0)
    assert len(agent.ask(Allocate(dry_run=True)).result["lines"]) == 2
    told = "3 tasks are not allocated, from a/W2 on: a team allocates at most 512 tasks"
    assert agent.lines("warning") == [told]


def test_a_solver_that_fails_holds_no_answer_up(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> None:
        raise ImportError("libhighs.so: cannot open shared object file")

    monkeypatch.setattr("pancakes.durable.allocator.has_solver", lambda: True)
    monkeypatch.setattr("pancakes.durable.allocator.optimum_of", fails)
    a = fleet.start("a", services=part(), tasks=work(1))
    told = a.ask(Allocate(dry_run=True)).result
    assert told["optimum"] is None and any("libhighs.so" in it for it in a.lines("warning"))


def test_costs_of_plug_ins_are_asked_for_a_few_at_a_time(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting: list[int] = [0]
    answer = Appraiser.take_message

    def asks(actor: Any, message: Any) -> None:
        waiting.append(waiting[-1] + isinstance(message, Appraise))
        tell(actor, message)

    def answers(self: Appraiser, message: Any) -> Any:
        waiting.append(waiting[-1] - 1)
        return answer(self, message)

    monkeypatch.setattr("pancakes.durable.allocator.tell", asks)
    monkeypatch.setattr(Appraiser, "take_message", answers)
    cells = {"battery": "null.battery"}
    a = fleet.start("a", services=part(20), devices=cells, tasks=work(12, Reach, cost="test.far"))
    a.publish("system", Battery(5.0, 1.0))
    lines = a.ask(Allocate(dry_run=True)).result["lines"]
    assert len(lines) == 12 and all(line["bids"] for line in lines)
    assert 1 < max(waiting) <= 2 * MOST_ASKED  # for the round, and to look whether one is due
