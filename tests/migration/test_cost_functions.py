"""What a candidate counts as its cost, and how several counts are weighed against each other."""

from __future__ import annotations

import math
from importlib.metadata import entry_points

import pytest
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.devices import Reserve
from pancakes.durable.messages import Solicit
from pancakes.durable.negotiation import Capability
from pancakes.durable.record import TaskId
from pancakes.errors import ClassError, MigrationError
from pancakes.migration import (
    ActiveTasks,
    BusyHost,
    Cost,
    CostFacts,
    EmptyBattery,
    HostLoad,
    RoundTrip,
    ShortReserve,
    Weighted,
    cost_of,
    cost_text,
    fault_of,
    fault_of_choice,
)
from pancakes.packet import body_from_plain

ROBOT = HostLoad(3, battery_level=0.6, agent_share=0.25, host_share=0.5, lateness_share=0.01, rtt_s=0.02)
KNOWN: dict[str, Cost] = {cost.name: cost for cost in (ActiveTasks(), EmptyBattery(), BusyHost(), RoundTrip())}


@pytest.mark.parametrize(
    ("name", "terms"),
    [
        ("tasks", {"active tasks": 3.0}),
        ("battery", {"battery used": pytest.approx(0.4)}),
        ("load", {"agent": 0.25, "host": 0.5, "lateness": 0.01}),
        ("link", {"round trip": 0.02}),
    ],
)
def test_each_function_states_its_terms(name: str, terms: dict[str, float]) -> None:
    assert KNOWN[name].terms(CostFacts(ROBOT)) == terms


def test_the_emptier_the_dearer_and_the_mains_are_free() -> None:
    levels = [1.0, 0.7, 0.1, 0.0]
    costs = [EmptyBattery()(CostFacts(replace(ROBOT, battery_level=level))) for level in levels]
    assert costs == sorted(costs) and costs[0] == 0.0 and costs[-1] == 1.0
    assert EmptyBattery()(CostFacts(replace(ROBOT, battery_level=None))) == 0.0


@pytest.mark.parametrize(
    ("name", "load", "why"),
    [
        ("battery", replace(ROBOT, battery_level=math.nan), "its battery has not been read yet"),
        ("load", replace(ROBOT, agent_share=None), "its load has not been measured yet"),
        ("link", replace(ROBOT, rtt_s=None), "its round trip to the source has not been measured yet"),
    ],
)
def test_what_is_not_known_is_not_guessed(name: str, load: HostLoad, why: str) -> None:
    with pytest.raises(MigrationError, match=why):
        KNOWN[name].terms(CostFacts(load))
    with pytest.raises(MigrationError, match=why):
        cost_of({"tasks": 1.0, name: 2.0}, KNOWN).terms(CostFacts(load))


def test_weights_multiply_each_term_and_the_sum_is_the_cost() -> None:
    cost = cost_of({"tasks": 1.0, "battery": 2.0, "link": 50.0}, KNOWN)
    assert cost.terms(CostFacts(ROBOT)) == {
        "tasks: active tasks": 3.0,
        "battery: battery used": pytest.approx(0.8),
        "link: round trip": pytest.approx(1.0),
    }
    assert cost(CostFacts(ROBOT)) == pytest.approx(4.8)


def test_weighted_without_weights_takes_all_four_once() -> None:
    assert Weighted()(CostFacts(ROBOT)) == pytest.approx(3.0 + 0.4 + 0.76 + 0.02)


def test_what_a_cost_reads_is_a_tuple_of_device_types() -> None:
    # A string would be read as one device type for each of its letters.
    with pytest.raises(ClassError, match=r"Far\.reads is 'pose': write a tuple of device types"):

        class Far(Cost):
            name = "far"
            reads = "pose"  # type: ignore[assignment]

            def terms(self, facts: CostFacts) -> dict[str, float]:
                return {"metres": facts.reading("pose").x_m}


def test_a_part_that_lies_makes_the_whole_no_bid() -> None:
    class Lying(Cost):
        name = "lying"

        def terms(self, facts: CostFacts) -> dict[str, float]:
            return {"charm": -5.0}

    terms = cost_of({"tasks": 2.0, "lying": 1.0}, {**KNOWN, "lying": Lying()}).terms(CostFacts(ROBOT))
    # Its sum is positive all the same, so each term is looked at.
    assert fault_of(sum(terms.values()), terms) == "its lying: charm is negative (-5)"


@pytest.mark.parametrize(
    ("choice", "fault"),
    [
        ({}, "cost names no cost function"),
        ("", "no cost function is named"),
        ({"tasks": -1.0}, "cost.tasks: a weight is a finite number of at least 0, not -1"),
        ({"tasks": math.nan, "battery": math.inf}, "not nan; cost.battery: a weight is"),
    ],
)
def test_weights_that_are_none(choice: str | dict[str, float], fault: str) -> None:
    assert fault in fault_of_choice(choice)
    with pytest.raises(MigrationError):
        cost_of(choice, KNOWN)


def test_a_candidate_refuses_functions_that_it_does_not_know_and_weights_that_are_none() -> None:
    asked = Solicit(TaskId("a", "X"), 1, "x", "1", "client", cost={"tasks": 1.0, "charm": 1.0, "wit": 1.0})
    here = Capability(version="1", costs=("tasks",))
    assert here.refusal_of(asked) == Refusal("unsupported", "knows no cost functions 'charm', 'wit'")
    assert "not nan" in str(here.refusal_of(replace(asked, cost={"tasks": math.nan})))
    assert here.refusal_of(replace(asked, cost={"tasks": 0.0})) is None


def test_the_choice_travels() -> None:
    plain = {"task_id": ["a", "X"], "ask": 1, "type": "x", "version": "1", "service": "client"}
    weights = {"tasks": 1, "battery": 2.5}
    assert body_from_plain("migration.solicit", {**plain, "cost": weights}).cost == weights
    assert body_from_plain("migration.solicit", {**plain, "cost": "link"}).cost == "link"


def test_people_read_the_weights() -> None:
    assert cost_text("tasks") == "tasks"
    assert cost_text({"tasks": 1.0, "battery": 2.5}) == "1 tasks + 2.5 battery"


def test_all_of_them_come_by_entry_point() -> None:
    found = {point.name: point.load() for point in entry_points(group="pancakes.costs")}
    assert {name: found[name].name for name in ("tasks", "battery", "load", "link", "weighted")} == {
        name: name for name in ("tasks", "battery", "load", "link", "weighted")
    }


def test_the_shorter_the_reserve_the_dearer_and_the_mains_are_free() -> None:
    def cost(seconds: float) -> float:
        return ShortReserve()(CostFacts(ROBOT, {"reserve": Reserve(seconds, 0.5)}))

    assert [cost(600.0), cost(60.0), cost(6.0)] == pytest.approx([0.1, 1.0, 10.0])
    assert ShortReserve()(CostFacts(replace(ROBOT, battery_level=None))) == 0.0


@pytest.mark.parametrize(
    ("readings", "why"),
    [
        ({"reserve": Reserve(0.0, 0.0)}, "it must go to a dock itself: its reserve is 0 s"),
        ({"reserve": Reserve(-7.0, -0.1)}, "its reserve is -7 s"),
        ({}, "its reserve has not been read yet"),
    ],
)
def test_a_robot_without_a_reserve_does_not_bid(readings: dict[str, Reserve], why: str) -> None:
    with pytest.raises(MigrationError, match=why):
        ShortReserve()(CostFacts(ROBOT, readings))
