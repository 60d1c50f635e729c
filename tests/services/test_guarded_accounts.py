"""What is said of a guarded task that was taken over: from which agent, from which checkpoint, and how old that was."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from services.counting import Count

from pancakes.control import Create, Guarding, Migrations, Stop, Take
from pancakes.durable.takeovers import CALLED_S
from pancakes.packet import NETWORK, Packet
from pancakes.testing import Fleet

GUARDED: Any = {
    "type": "test.Count",
    "guard": {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5, "guardians": ["b", "c"]},
}
CAUSE = r"taken over from a, silent for (\d+\.\d) s; checkpoint 0@a/\d+, (\d\.\d) s old at its last word"


class Idle(Count):
    """Changes nothing."""

    def tick(self, tick: Any) -> None:
        pass


@pytest.fixture(params=["auto", "ask"])
def fleet(request: Any) -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count, "test.Idle": Idle}) as made:
        made.start("a", tasks={"Count": {**GUARDED, "guard": {**GUARDED["guard"], "takeover": request.param}}})
        for name in "bc":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: has_guards(made), 10)
        made.run_for(3.0)
        yield made


def has_guards(fleet: Fleet) -> bool:
    rows = fleet.agents["a"].ask(Guarding()).result
    return len(rows) == 1 and len(rows[0]["guardians"]) == 3


def accounts(fleet: Fleet) -> list[dict[str, Any]]:
    return [row for name in "bc" for row in fleet.agents[name].ask(Migrations()).result]


@pytest.mark.parametrize("fleet", ["auto"], indirect=True)
def test_its_account_says_from_which_agent_and_checkpoint_it_was_taken_over(fleet: Fleet):
    fleet.crash("a")
    assert fleet.run_until(lambda: bool(accounts(fleet)), 8)
    (account,) = accounts(fleet)
    told = re.fullmatch(CAUSE, account["cause"])
    assert told, account["cause"]
    assert 1.9 < float(told[1]) < 3.0 and float(told[2]) <= 0.7
    assert (account["source"], account["asked_by"], account["outcome"]) == ("a", "guardians", "moved")
    taker = fleet.agents[account["winner"]]
    (taken,) = taker.events("task_taken")
    assert taken["source_agent"] == "a" and taken["epoch"] == 1
    lines = [line for name in "bc" for line in fleet.agents[name].lines("warning")]
    assert any(re.search(f"a/Count runs on {account['winner']}, {CAUSE}", line) for line in lines)


@pytest.mark.parametrize("fleet", ["ask"], indirect=True)
def test_a_dry_run_names_the_taker_and_what_is_lost(fleet: Fleet):
    fleet.crash("a")
    fleet.run_for(10.0)
    would = fleet.agents["b"].ask(Take("Count", dry_run=True)).result
    assert would["winner"] in "bc" and re.fullmatch(r"0@a/\d+", would["checkpoint"])
    assert would["age_s"] <= 0.7 and 9.0 < would["silent_s"] < 12.0
    took = fleet.agents["b"].ask(Take("Count")).result
    assert took["winner"] in "bc" and took["checkpoint"] == would["checkpoint"] and took["age_s"] == would["age_s"]


@pytest.mark.parametrize("fleet", ["ask"], indirect=True)
def test_a_take_over_that_is_asked_for_twice_is_done_once(fleet: Fleet):
    fleet.crash("a")
    fleet.run_for(10.0)
    b = fleet.agents["b"]
    first, second = b.publish("sysctrl", Take("Count")), b.publish("sysctrl", Take("Count"))
    assert b.reply_to(second).reason == "a/Count is being taken over already"
    assert b.reply_to(first).ok
    fleet.run_for(2.0)
    assert len(accounts(fleet)) == 1


@pytest.mark.parametrize("fleet", ["ask"], indirect=True)
def test_where_too_few_guardians_say_that_its_owner_is_silent_it_is_not_taken_over(fleet: Fleet):
    fleet.crash("a")
    fleet.run_for(10.0)
    fleet.crash("c")
    refused = fleet.agents["b"].ask(Take("Count"))
    assert refused.reason == (
        "a/Count is not taken over: 1 of its 3 guardians say that its owner is silent, and not a, c"
    )
    fleet.restart("c")
    fleet.connect()
    fleet.run_for(3.0)
    assert fleet.agents["b"].ask(Take("Count")).ok


@pytest.mark.parametrize("fleet", ["auto"], indirect=True)
def test_a_task_that_a_person_has_stopped_is_taken_over_by_none(fleet: Fleet):
    assert fleet.agents["a"].ask(Stop("Count")).ok
    fleet.run_for(3.0)
    fleet.crash("a")
    fleet.run_for(10.0)
    assert accounts(fleet) == []
    assert fleet.agents["b"].ask(Take("Count")).reason == (
        "a/Count is not to run, as its checkpoint says: there is nothing to take over"
    )


def test_of_two_tasks_of_one_name_the_birthplace_says_which_is_taken_over():
    rule = {**GUARDED, "guard": {**GUARDED["guard"], "takeover": "ask", "guardians": ["c", "d"]}}
    with Fleet(seed=5, classes={"test.Count": Count}) as fleet:
        for name in "ab":
            fleet.start(name, tasks={"Count": rule})
        for name in "cd":
            fleet.start(name)
        fleet.connect()
        c = fleet.agents["c"]
        assert fleet.run_until(lambda: len(c.ask(Guarding()).result) == 2, 20)
        fleet.run_for(3.0)
        fleet.crash("a")
        fleet.crash("b")
        fleet.run_for(10.0)
        told = c.ask(Take("Count")).reason
        assert re.fullmatch(r"c guards (a/Count and b/Count|b/Count and a/Count): say which birthplace is meant", told)
        taken = c.ask(Take("Count", "b")).result
        assert taken["task_id"] == "b/Count"


@pytest.mark.parametrize("fleet", ["ask"], indirect=True)
def test_a_guardian_that_began_anew_says_that_it_does_not_know_the_age(fleet: Fleet):
    for name in "abc":
        fleet.crash(name)
    for name in "bc":
        fleet.restart(name)
    fleet.connect()
    fleet.run_for(8.0)
    assert fleet.agents["b"].ask(Take("Count", dry_run=True)).result["age_s"] is None


def test_a_checkpoint_of_a_task_that_does_not_change_grows_no_older():
    with Fleet(seed=5, classes={"test.Idle": Idle}) as fleet:
        fleet.start("a", tasks={"Count": {**GUARDED, "type": "test.Idle"}})
        for name in "bc":
            fleet.start(name)
        fleet.connect()
        assert fleet.run_until(lambda: has_guards(fleet), 10)
        fleet.run_for(60.0)
        (row,) = fleet.agents["b"].ask(Guarding()).result
        assert row["age_s"] < 1.5
        fleet.crash("a")
        fleet.run_for(1.0)
        (later,) = fleet.agents["b"].ask(Guarding()).result
        assert row["age_s"] < later["age_s"] < 3.0


@pytest.mark.parametrize("fleet", ["ask"], indirect=True)
def test_the_newest_checkpoint_is_named_that_any_guardian_has(fleet: Fleet):
    fleet.faults.cut("b", off=("a",))
    fleet.run_for(5.0)
    fleet.crash("a")
    fleet.run_for(8.0)
    (ours,), (theirs,) = (fleet.agents[name].ask(Guarding()).result for name in "bc")
    assert ours["checkpoint"] < theirs["checkpoint"]
    would = fleet.agents["b"].ask(Take("Count", dry_run=True)).result
    assert would["checkpoint"] == f"0@a/{theirs['checkpoint']}" and would["age_s"] <= 0.7


@pytest.mark.parametrize("fleet", ["auto"], indirect=True)
def test_where_the_cheapest_bidder_dies_once_it_is_called_the_next_one_takes_it(fleet: Fleet):
    d = fleet.start("d")
    fleet.connect()
    called: list[Packet] = []
    d.kernel.stream.tap(NETWORK, called.append, ("task.call",))
    for name in "bc":
        assert fleet.agents[name].ask(Create("Other", "test.Count")).ok

    def moved() -> list[dict[str, Any]]:
        return [row for row in accounts(fleet) if row["task_id"] == "a/Count"]

    fleet.crash("a")
    assert fleet.run_until(lambda: bool(called), 8)
    fleet.crash("d")
    assert fleet.run_until(lambda: bool(moved()), 8)
    (account,) = moved()
    assert account["winner"] in ("b", "c")
    fates = {line["peer"]: (line["fate"], line["reason"]) for line in account["lines"]}
    assert fates["d"] == ("failed", f"did not take it within {CALLED_S:g} s")


@pytest.mark.parametrize("fleet", ["auto"], indirect=True)
def test_an_agent_that_does_not_guard_it_takes_it_if_it_bids_lowest(fleet: Fleet):
    """Each of the two guardians that are left promises it: one has called it, the other hears that from that one."""
    fleet.start("d")
    fleet.connect()
    for name in "bc":
        assert fleet.agents[name].ask(Create("Other", "test.Count")).ok
    fleet.crash("a")
    assert fleet.run_until(lambda: fleet.agents["d"].running() == ["Count"], 6)
    (account,) = (row for row in accounts(fleet) if row["task_id"] == "a/Count")
    assert account["winner"] == "d" and [line["fate"] for line in account["lines"]].count("failed") == 0
