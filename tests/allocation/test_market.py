"""What an allocation is worth, which ones are allowed, and the best one: compared with trying them all."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from allocation.rounds import Robot, drawn
from msgspec.structs import replace

from pancakes.durable import market as markets
from pancakes.durable.market import (
    MOST_LOTS,
    Lot,
    Market,
    Row,
    fault_of_lot,
    fault_of_row,
    market_of,
    timetable,
)
from pancakes.durable.optimum import optimum_of


def market(robots: dict[str, Robot]) -> Market:
    rows = {
        name: Row(1, "r", False, 1, it.at_most, it.crowding, dict(it.lots), dict(it.costs))
        for name, it in robots.items()
    }
    return market_of(rows)


def best_of_all(market: Market) -> float:
    """Returns what the best allocation is worth, by trying all."""
    best = 0.0
    keys = list(market.lots)
    for agents in itertools.product([None, *market.rows], repeat=len(keys)):
        bundles: dict[str, list[str]] = {}
        for key, agent in zip(keys, agents, strict=True):
            if agent is not None:
                bundles.setdefault(agent, []).append(key)
        if market.value(bundles) > best and not market.faults(bundles):
            best = market.value(bundles)
    return best


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("coupled", [False, True], ids=["plain", "coupled"])
def test_the_solver_finds_what_trying_all_finds(seed: int, coupled: bool) -> None:
    pytest.importorskip("highspy")
    found = market(drawn(seed, 3, 4, coupled=coupled, at_most=1 + seed % 3))
    solved = optimum_of(found)
    assert solved is not None
    value, bundles = solved
    assert value == pytest.approx(best_of_all(found), abs=1e-6)
    assert value == pytest.approx(found.value(bundles))


def test_the_best_allocation_of_nothing_is_worth_nothing() -> None:
    pytest.importorskip("highspy")
    assert optimum_of(market({"r": Robot()})) == (0.0, {})
    assert optimum_of(market({"r": Robot(lots={"r/T": Lot(1.0)})})) == (0.0, {})


def test_the_best_allocation_gives_what_belongs_together_to_different_agents() -> None:
    pytest.importorskip("highspy")
    lots = {"a/T": Lot(5.0, together=("U",)), "a/U": Lot(5.0)}
    both = dict.fromkeys(lots, 0.0)
    assert optimum_of(market({"a": Robot(2, 0.0, lots, both), "b": Robot(2)})) == (0.0, {})
    found = optimum_of(market({"a": Robot(2, 0.0, lots, both), "b": Robot(2, 0.0, {}, {"a/U": 1.0})}))
    assert found == (9.0, {"a": ["a/T"], "b": ["a/U"]})


def test_a_bid_falls_by_what_the_task_costs_by_each_task_before_it_and_by_the_price_of_a_move() -> None:
    costs = {"a/T": 2.0, "a/U": 1.0}
    robots = {
        "a": Robot(2, 0.5, {"a/T": Lot(10.0, 3.0), "a/U": Lot(10.0, 3.0)}, costs),
        "b": Robot(2, 0.5, {}, costs),
    }
    found = market(robots)
    assert (found.bid("a", "a/T", 0), found.bid("a", "a/T", 1)) == (8.0, 7.5)
    assert found.bid("b", "a/T", 0) == 5.0
    assert found.value({"a": ["a/T", "a/U"]}) == found.value({"a": ["a/U", "a/T"]}) == 16.5


GOOD = Row(1, "r", False, 1, 2, 0.0, {"a/T": Lot(1.0)}, {"a/T": 1.0, "b/U": 2.0}, {}, ("a/T",))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"costs": {"a/T": math.nan}}, "its cost of a/T is nan"),
        ({"costs": {"a/T": math.inf}}, "its cost of a/T is inf"),
        ({"costs": {"a/T": -1.0}}, "its cost of a/T is negative (-1)"),
        ({"crowding": math.nan}, "its crowding is nan"),
        ({"crowding": -1.0}, "its crowding is -1"),
        ({"at_most": -1}, "it would take -1 tasks, not 0 to 256"),
        ({"at_most": 10**9}, "it would take 1000000000 tasks, not 0 to 256"),
        ({"at_most": 0}, "it claims 1 tasks, and takes at most 0"),
        ({"bundle": ("a/T", "a/T")}, "it claims a task twice"),
        ({"bundle": ("c/V",)}, "it claims c/V and tells no cost of it"),
        ({"costs": {str(it): 1.0 for it in range(MOST_LOTS + 1)}}, "it names more than 512 tasks or agents"),
        ({"lots": {"a/T": Lot(math.nan)}}, "a/T: value must be a number > 0 and at most 1e+12, not nan"),
    ],
)
def test_a_row_that_cannot_be_true_does_not_count(wrong: dict[str, object], sentence: str) -> None:
    assert fault_of_row(GOOD) == ""
    assert fault_of_row(replace(GOOD, **wrong)) == sentence


@pytest.mark.parametrize(
    "wrong", [{"value": 0.0}, {"value": math.inf}, {"move_price": -1.0}, {"takes_s": math.nan}, {"ends_by_s": math.nan}]
)
def test_a_lot_is_worth_something_and_takes_a_time_that_is_one(wrong: dict[str, float]) -> None:
    assert fault_of_lot(Lot(1.0)) == ""
    assert next(iter(wrong)) in fault_of_lot(replace(Lot(1.0), **wrong))


def left_out(lots: dict[str, Lot], others: dict[str, Lot] | None = None) -> dict[str, str]:
    return market({"a": Robot(lots=lots), "b": Robot(lots=others or {})}).left_out


def test_what_cannot_be_allocated_is_left_out_with_a_reason() -> None:
    assert left_out({"a/T": Lot(1.0)}, {"a/T": Lot(9.0)}) == {"a/T": "both a and b say that they have it"}
    circle = left_out({"a/T": Lot(1.0, after=("U",)), "a/U": Lot(1.0, after=("T",)), "a/V": Lot(1.0, after=("U",))})
    assert set(circle) == {"a/T", "a/U", "a/V"} and set(circle.values()) == {"it waits for itself"}
    lonely = left_out({"a/T": Lot(1.0, together=("Nobody",)), "a/U": Lot(1.0, after=("T",)), "a/V": Lot(1.0)})
    assert lonely == {
        "a/T": "it needs Nobody at the same time, which nobody puts up",
        "a/U": "it comes after T, which is left out",
    }


def test_what_nobody_puts_up_is_over() -> None:
    assert left_out({"a/T": Lot(1.0, after=("Done",))}) == {}
    found = market({"a": Robot(lots={"a/T": Lot(1.0, takes_s=3.0, after=("Done",))}, costs={"a/T": 0.0})})
    assert timetable(found, {"a": ["a/T"]}) == {"a/T": 3.0}


def test_an_agent_works_at_one_after_the_other_and_first_at_what_is_due_first() -> None:
    lots = {
        "a/Long": Lot(1.0, takes_s=10.0),
        "a/Soon": Lot(1.0, takes_s=2.0, ends_by_s=2.0),
        "a/Beside": Lot(1.0, ends_by_s=0.0),
        "b/Then": Lot(1.0, takes_s=1.0, after=("Long",)),
        "b/Never": Lot(1.0, after=("Nobodys",)),
        "b/Nobodys": Lot(1.0),
    }
    found = market({"a": Robot(lots=lots), "b": Robot()})
    ends = timetable(found, {"a": ["a/Long", "a/Soon", "a/Beside"], "b": ["b/Then", "b/Never"]})
    assert ends == {"a/Soon": 2.0, "a/Long": 12.0, "a/Beside": 0.0, "b/Then": 13.0}


def planned(found: Market, bundles: dict[str, list[str]]) -> dict[str, float]:
    """Returns the timetable by its definition: of all lots that can begin, the one that can begin first is next."""
    agents = {key: agent for agent, keys in bundles.items() for key in keys}
    ends = {key: 0.0 for key in agents if not (found.lots[key].lot.takes_s or found.before[key])}
    free_s = dict.fromkeys(bundles, 0.0)
    while True:
        can = []
        for key, agent in agents.items():
            lot = found.lots[key].lot
            if key not in ends and all(it in ends for it in found.before[key]):
                ready_s = max((ends[it] for it in found.before[key]), default=0.0)
                due_s = math.inf if lot.ends_by_s is None else lot.ends_by_s
                can.append((max(ready_s, free_s[agent]) if lot.takes_s else ready_s, due_s, key))
        if not can:
            return ends
        begin_s, _, key = min(can)
        ends[key] = begin_s + found.lots[key].lot.takes_s
        if found.lots[key].lot.takes_s:
            free_s[agents[key]] = ends[key]


@pytest.mark.parametrize("seed", range(20))
def test_a_timetable_is_that_of_its_definition(seed: int) -> None:
    found = market(drawn(seed, 3, 20, coupled=True))
    bundles: dict[str, list[str]] = {agent: [] for agent in found.rows}
    for number, key in enumerate(found.lots):
        bundles[sorted(bundles)[number * (seed + 1) % 5 % 3]].append(key)
    assert timetable(found, bundles) == planned(found, bundles)


def test_a_timetable_looks_at_each_lot_a_few_times_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """An auction plans for each lot that it may add: with the square of the lots, a large team's never ended."""
    chain = {
        f"a/T{number}": Lot(1.0, takes_s=1.0, after=(f"T{number - 2}",) if number > 1 else ()) for number in range(256)
    }
    robots = {"a": Robot(lots=chain), "b": Robot(lots={f"b/U{number}": Lot(1.0, takes_s=1.0) for number in range(256)})}
    found = market(robots)
    looked_at = 0
    whole = markets.heappop

    def heappop(queue: list[Any]) -> Any:
        nonlocal looked_at
        looked_at += 1
        return whole(queue)

    monkeypatch.setattr(markets, "heappop", heappop)
    assert len(timetable(found, {name: list(robot.lots) for name, robot in robots.items()})) == 512
    assert 512 <= looked_at <= 4 * 512


def test_what_an_allocation_breaks_is_named() -> None:
    lots = {"a/T": Lot(1.0, together=("U",)), "a/U": Lot(1.0), "a/V": Lot(1.0, takes_s=2.0, ends_by_s=1.0)}
    found = market({"a": Robot(1, 0.0, lots, dict.fromkeys(lots, 0.0)), "b": Robot(1, 0.0, {}, {"a/T": 0.0})})
    assert found.faults({"a": ["a/U"], "b": ["a/T"]}) == []
    assert found.faults({"b": ["a/U"]})[0] == "b cannot take a/U"
    assert "a has too many" in found.faults({"a": ["a/T", "a/U"]})
    assert "a/T needs a/U on another agent" in found.faults({"a": ["a/T", "a/U"]})
    assert "a/T needs a/U on another agent" in found.faults({"b": ["a/T"]})
    assert "a task is allocated twice" in found.faults({"a": ["a/T"], "b": ["a/T"]})
    assert "a/V is not over in time" in found.faults({"a": ["a/V"]})


def test_the_solver_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("highspy")
    optimum_of(market(drawn(1, 2, 3)))
    assert capfd.readouterr().out == ""
