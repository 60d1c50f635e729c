"""Rounds of the allocation over a network that loses, doubles, delays and reorders packets."""

from __future__ import annotations

import math
from typing import Any

import pytest
from allocation.rounds import Robot, Team, drawn
from msgspec.structs import replace

from pancakes.durable import auction as auctions
from pancakes.durable import completion
from pancakes.durable.auction import PLANNED, PLANNED_PER_S, Round, RoundId
from pancakes.durable.completion import allowed, calmed, completed
from pancakes.durable.market import MOST_LOTS, Lot, Market, Row, market_of


def held(robots: dict[str, Robot], *, loss: float = 0.2, seed: int = 1, starter: str = "") -> Team:
    team = Team(robots, loss, seed)
    team.begin(starter or min(robots))
    team.run()
    return team


def lines(team: Team, agent: str = "") -> dict[str, tuple[str, str]]:
    """Returns who wins each task as an agent knows it, and why nobody does."""
    name = agent or min(team.rounds)
    report = team.rounds[name].report(list(team.robots), team.now_s)
    return {it.task: (it.winner, it.reason) for it in report.lines}


@pytest.mark.parametrize("seed", range(4))
def test_all_agents_come_to_the_same_allowed_allocation_although_packets_are_lost(seed: int) -> None:
    team = held(drawn(seed, 5, 12, at_most=3), loss=0.3, seed=seed)
    assert all(auction.agreed for auction in team.rounds.values())
    assert len({str(lines(team, name)) for name in team.robots}) == 1
    found = next(iter(team.rounds.values())).market
    assert len(found.lots) == 12 and found.faults(team.allocation()) == []


@pytest.mark.parametrize(("robots", "tasks", "seed"), [*((3, 8, seed) for seed in range(8)), (4, 12, 14)])
def test_coupled_tasks_are_never_allocated_so_that_a_coupling_is_broken(robots: int, tasks: int, seed: int) -> None:
    team = held(drawn(seed, robots, tasks, coupled=True), seed=seed)
    assert len({str(lines(team, name)) for name in team.robots}) == 1
    assert next(iter(team.rounds.values())).market.faults(team.allocation()) == []


def test_the_loss_of_packets_changes_no_result() -> None:
    robots = drawn(3, 4, 10)
    assert lines(held(robots, loss=0.0)) == lines(held(robots, loss=0.4, seed=5))


def test_the_nearest_agent_with_a_place_left_gets_a_task() -> None:
    lots = {"a/T": Lot(10.0), "a/U": Lot(10.0), "a/V": Lot(10.0)}
    robots = {
        "a": Robot(1, 0.0, lots, {"a/T": 1.0, "a/U": 5.0, "a/V": 5.0}),
        "b": Robot(1, 0.0, {}, {"a/T": 5.0, "a/U": 1.0, "a/V": 2.0}),
    }
    why = "no agent that can take it has a place left"
    assert lines(held(robots)) == {"a/T": ("a", ""), "a/U": ("b", ""), "a/V": ("", why)}


@pytest.mark.parametrize(("gain", "winner"), [(0.9, "a"), (1.0, "a"), (1.1, "b")])
def test_a_gain_that_is_not_greater_than_the_price_of_a_move_moves_nothing(gain: float, winner: str) -> None:
    robots = {"a": Robot(1, 0.0, {"a/T": Lot(10.0, 1.0)}, {"a/T": 2.0}), "b": Robot(1, 0.0, {}, {"a/T": 2.0 - gain})}
    assert lines(held(robots))["a/T"] == (winner, "")


def test_a_task_that_no_agent_can_do_and_one_that_costs_more_than_it_is_worth_stay() -> None:
    robots = {
        "a": Robot(3, 0.0, {"a/T": Lot(10.0), "a/U": Lot(1.0)}, {"a/U": 2.0}),
        "b": Robot(3, 0.0, {}, {"a/U": 3.0}),
    }
    team = held(robots)
    assert lines(team) == {
        "a/T": ("", "no agent can take it"),
        "a/U": ("", "it costs each agent more than it is worth"),
    }
    (first, _) = team.rounds["a"].report(["b", "c"], team.now_s).lines
    assert first.refusals == {"a": "lacks the device type gripper", "b": "lacks the device type gripper"}


def test_tasks_that_belong_together_go_to_different_agents_or_to_none() -> None:
    pair = {"a/T": Lot(10.0, together=("U",)), "a/U": Lot(10.0)}
    one, both = {"a/T": 1.0}, {"a/T": 1.0, "a/U": 1.0}
    assert {
        winner for winner, _ in lines(held({"a": Robot(2, 0.0, pair, both), "b": Robot(2, 0.0, {}, both)})).values()
    } == {
        "a",
        "b",
    }
    alone = held({"a": Robot(2, 0.0, pair, both), "b": Robot(2)})
    assert [winner for winner, _ in lines(alone).values()] == ["", ""]
    assert "finds no agent at the same time" in lines(alone)["a/T"][1] + lines(alone)["a/U"][1]
    # What a part of a group took up is free for others again.
    more = {**pair, "a/V": Lot(5.0)}
    freed = held({"a": Robot(1, 0.0, more, {**one, "a/V": 1.0}), "b": Robot(1)})
    assert lines(freed)["a/V"] == ("a", "") and lines(freed)["a/T"][0] == ""


def test_a_task_makes_room_for_a_pair_that_is_worth_more() -> None:
    """Each auction fills a's only place with V first, so T would find no agent."""
    lots = {"a/T": Lot(9.0, together=("U",)), "a/U": Lot(9.0), "a/V": Lot(9.5)}
    robots = {
        "a": Robot(1, 0.0, lots, {"a/T": 1.0, "a/V": 1.0}),
        "b": Robot(1, 0.0, {}, {"a/U": 1.0, "a/V": 8.0}),
    }
    assert {key: winner for key, (winner, _) in lines(held(robots)).items()} == {"a/T": "a", "a/U": "b", "a/V": ""}
    # If what makes room finds another place, it takes it.
    robots["c"] = Robot(1, 0.0, {}, {"a/V": 8.0})
    assert lines(held(robots))["a/V"] == ("c", "")


def test_a_group_that_fits_only_if_others_change_their_robots_finds_its_place() -> None:
    """Two others have to leave a robot before the first task of an order is over in time there: 76 % without."""
    team = held(drawn(21, 5, 15, coupled=True, at_most=4))
    market = team.rounds["robot0"].market
    assert market.value(team.allocation()) >= 0.99 * 125.99196741469395  # the best, as `optimum_of` finds


def test_what_is_added_does_not_depend_on_which_rows_came_first() -> None:
    robots = drawn(6, 3, 8, coupled=True)
    rows = {
        name: Row(1, "robot0", at_most=it.at_most, crowding=it.crowding, lots=dict(it.lots), costs=dict(it.costs))
        for name, it in robots.items()
    }
    market, names = market_of(rows), sorted(rows)
    found = completed(market, {agent: [] for agent in names})
    assert market.value(found) > 0.0 and market.faults(found) == []
    assert found == completed(market, {agent: [] for agent in reversed(names)})


def test_an_agent_thinks_no_longer_about_a_large_team_than_about_a_small_one(monkeypatch: pytest.MonkeyPatch) -> None:
    market, there = most_lots(**dict.fromkeys(NAMES, Lot(9.0, takes_s=1.0, ends_by_s=300.0)))
    planned = counted(monkeypatch, "timetable")
    found = completed(market, {"a": there["a"][:200], "b": there["b"][:200]})
    assert market.faults(found) == [] and len(planned) <= 5


def test_an_agent_that_does_not_hear_of_all_adds_nothing_to_what_others_claim() -> None:
    """b is in the middle, and has promised its only place to c, of which a does not hear."""
    pair = {"a/T": Lot(9.0, together=("U",)), "a/U": Lot(9.0)}
    robots = {
        "a": Robot(1, 0.0, pair, {"a/T": 1.0}),
        "b": Robot(1, 0.0, {}, {"a/U": 1.0, "c/W": 1.0}),
        "c": Robot(1, 0.0, {"c/W": Lot(20.0)}, {}),
    }
    team = Team(robots)
    team.apart.add(frozenset("ac"))
    team.begin("a")
    team.run()
    assert team.rounds["a"].agreed and "c" not in team.rounds["a"].market.rows
    assert team.allocation() == {"a": [], "b": ["c/W"], "c": []}


def test_an_agent_that_hears_of_all_adds_nothing_if_others_do_not() -> None:
    """a does not hear of c, so it would keep V on its only place, and could not take T."""
    robots = {
        "a": Robot(1, 0.0, {"a/V": Lot(9.5)}, {"a/V": 1.0, "b/T": 1.0}),
        "b": Robot(2, 0.0, {"b/T": Lot(9.0, together=("U",)), "b/U": Lot(9.0)}, {"a/V": 8.0, "b/U": 1.0}),
        "c": Robot(),
    }
    assert held(robots).allocation() == {"a": ["b/T"], "b": ["a/V", "b/U"], "c": []}
    team = Team(robots)
    team.apart.add(frozenset("ac"))
    team.begin("b")
    team.run()
    assert all(it.agreed for it in team.rounds.values())
    assert team.allocation() == {"a": ["a/V"], "b": [], "c": []}


NAMES = [f"T{number:03}" for number in range(MOST_LOTS)]


def most_lots(**lots: Lot) -> tuple[Market, dict[str, list[str]]]:
    """Returns a market of the most lots, in turns of a and b, and where they are."""
    there = {agent: {f"{agent}/{name}": lots[name] for name in NAMES["ab".index(agent) :: 2]} for agent in "ab"}
    costs = {key: 1.0 for mine in there.values() for key in mine}
    market = market_of({agent: Row(1, "a", at_most=256, lots=mine, costs=costs) for agent, mine in there.items()})
    assert len(market.lots) == MOST_LOTS
    return market, {agent: list(mine) for agent, mine in there.items()}


def counted(monkeypatch: pytest.MonkeyPatch, name: str) -> list[Any]:
    """Returns a list that gets longer with each call of a function of `completion`."""
    calls: list[Any] = []
    whole = getattr(completion, name)

    def called(*arguments: Any) -> Any:
        calls.append(arguments)
        return whole(*arguments)

    monkeypatch.setattr(completion, name, called)
    return calls


def test_a_group_of_all_tasks_of_a_team_is_not_tried_from_each_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else each agent would think for a quarter of a minute, and say nothing meanwhile."""
    market, _ = most_lots(**dict.fromkeys(NAMES, Lot(9.0, together=tuple(NAMES))))
    looked_at = counted(monkeypatch, "_is_possible")
    assert completed(market, {"a": [], "b": []}) == {"a": [], "b": []}
    assert len(looked_at) <= 2 * MOST_LOTS


def test_a_chain_of_tasks_that_breaks_is_not_planned_once_for_each_link(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = {name: Lot(9.0, together=(before,)) for name, before in zip(NAMES, [NAMES[1], *NAMES], strict=False)}
    market, there = most_lots(**chain)
    planned = counted(monkeypatch, "timetable")
    assert allowed(market, {**there, "a": there["a"][1:]}) == {"a": [], "b": []}
    assert len(planned) == 2


def test_of_many_migrations_that_gain_nothing_only_some_are_called_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes a timetable of all tasks."""
    market, there = most_lots(**dict.fromkeys(NAMES, Lot(9.0, takes_s=1.0)))
    tried: list[Any] = []

    def faults(*arguments: Any) -> list[str]:
        tried.append(arguments)
        return []

    monkeypatch.setattr(Market, "faults", faults)
    monkeypatch.setattr(Market, "value", lambda _, bundles: float(bundles is not there))
    calmed(market, {"a": there["b"], "b": there["a"]}, there)
    assert 1 <= len(tried) <= 10


def test_agent_plans_within_its_budget(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is an actor: it answers nobody while it plans. Each lot comes after another one, so all are in each plan."""
    chain = {name: Lot(9.0, takes_s=1.0, after=(before,)) for name, before in zip(NAMES[2:], NAMES, strict=False)}
    market, there = most_lots(**chain, **dict.fromkeys(NAMES[:2], Lot(9.0, takes_s=1.0)))
    planned, now_s = 0, 0.0
    whole = auctions.timetable

    def timetable(market: Market, bundles: dict[str, list[str]]) -> dict[str, float]:
        nonlocal planned
        planned += sum(map(len, bundles.values()))
        return whole(market, bundles)

    monkeypatch.setattr(auctions, "timetable", timetable)
    rows = market.rows
    auction = Round("a", RoundId(1, "a"), False, 256, 0.0, rows["a"].lots, now_s)
    auction.take("b", replace(rows["b"], seq=1, bundle=tuple(there["b"])), now_s)
    auction.price(rows["a"].costs, {}, now_s)
    for seq in range(2, 50):  # rows that come at once are no reason to plan more
        auction.take("b", replace(auction.market.rows["b"], seq=seq), now_s)
    assert 0 < planned <= PLANNED + MOST_LOTS and 0 < len(auction.row.bundle) < 256
    while len(auction.row.bundle) < 256:
        now_s += 0.1
        assert now_s < 5.0 and not auction.tick(now_s)
        assert planned <= PLANNED + PLANNED_PER_S * now_s + MOST_LOTS


def test_what_did_not_fit_is_tried_again() -> None:
    lots = {
        "a/First": Lot(9.0, takes_s=4.0),
        "a/Long": Lot(9.0, takes_s=6.0, ends_by_s=6.0),
        "a/Then": Lot(9.0, takes_s=2.0, ends_by_s=8.0, after=("First",)),
        "a/Other": Lot(20.0),
    }
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, lots, 0.0)
    auction.price({"a/Then": 1.0, "a/Other": 1.0}, {}, 0.0)
    assert auction.row.bundle == ("a/Other",)  # nobody works at what comes before
    row = Row(1, "a", at_most=2, costs={"a/First": 1.0, "a/Long": 1.0})
    for seq, (claims, mine) in enumerate(
        [
            (("a/First", "a/Long"), ("a/Other",)),
            (("a/First",), ("a/Other", "a/Then")),
            (("a/First", "a/Long"), ("a/Other",)),
            (("a/First",), ("a/Other", "a/Then")),
        ],
        1,
    ):
        auction.take("b", replace(row, seq=seq, bundle=claims), 0.0)
        assert auction.row.bundle == mine


def test_what_must_come_before_is_allocated_for_what_comes_after_it() -> None:
    """First alone is worth less than it costs the team's only place, First and Then together are worth more."""
    lots = {
        "a/First": Lot(3.0, takes_s=4.0),
        "a/Then": Lot(9.0, takes_s=4.0, ends_by_s=8.0, after=("First",)),
        "a/Other": Lot(6.0, takes_s=4.0, ends_by_s=4.0),
    }
    robots = {"a": Robot(2, 0.0, lots, dict.fromkeys(lots, 1.0))}
    assert {key: winner for key, (winner, _) in lines(held(robots)).items()} == {
        "a/First": "a",
        "a/Then": "a",
        "a/Other": "",
    }


def test_a_lot_that_is_late_takes_its_mate_with_it() -> None:
    lots = {"a/T": Lot(9.0, takes_s=5.0, ends_by_s=5.0, together=("U",)), "a/U": Lot(9.0), "a/V": Lot(9.0)}
    rows = {
        "a": Row(1, "a", at_most=3, lots=lots, costs={"a/T": 1.0, "a/V": 1.0}),
        "b": Row(1, "a", at_most=3, costs={"a/U": 1.0, "a/V": 1.0}),
    }
    market = market_of(rows)
    assert allowed(market, {"a": ["a/T"], "b": ["a/U", "a/V"]}) == {"a": ["a/T"], "b": ["a/U", "a/V"]}
    late = market_of({**rows, "a": replace(rows["a"], lots={**lots, "a/V": Lot(9.0, takes_s=4.0, ends_by_s=4.0)})})
    assert allowed(late, {"a": ["a/V", "a/T"], "b": ["a/U"]}) == {"a": ["a/V"], "b": []}


def test_of_more_tasks_than_a_team_allocates_the_first_count_and_the_others_say_why() -> None:
    """No agent puts up too many, but all together do."""
    lots = {name: {f"{name}/T{number:03}": Lot(10.0) for number in range(200)} for name in "abc"}
    everything = {key: 1.0 for mine in lots.values() for key in mine}
    team = held({name: Robot(4, 0.1, lots[name], everything) for name in "abc"})
    assert all(it.agreed and it.report([], 0.0).ignored == {} for it in team.rounds.values())
    found = lines(team)
    assert len({str(lines(team, name)) for name in team.robots}) == 1
    left_out = [key for key, (_, reason) in found.items() if reason == "a team allocates at most 512 tasks"]
    assert left_out == [f"c/T{number:03}" for number in range(112, 200)]
    assert sum(winner != "" for winner, _ in found.values()) == 12


def test_what_comes_after_another_task_is_planned_after_it_and_not_without_it() -> None:
    lots = {"a/First": Lot(5.0, takes_s=4.0), "a/Then": Lot(9.0, takes_s=3.0, after=("First",))}
    everywhere = dict.fromkeys(lots, 0.5)
    team = held({"a": Robot(1, 0.0, lots, everywhere), "b": Robot(1, 0.0, {}, everywhere)})
    report = team.rounds["a"].report(["b"], team.now_s)
    assert {it.task: it.over_s for it in report.lines} == {"a/First": 4.0, "a/Then": 7.0}
    without = held({"a": Robot(2, 0.0, lots, {"a/Then": 0.5})})
    assert lines(without)["a/Then"] == ("", "no agent with a place left can end it in time")


def test_a_deadline_that_one_agent_cannot_keep_is_kept_by_two() -> None:
    lots = {f"a/T{number}": Lot(10.0, takes_s=5.0, ends_by_s=10.0) for number in range(4)}
    everywhere = dict.fromkeys(lots, 1.0)
    alone = held({"a": Robot(4, 0.0, lots, everywhere)})
    assert sorted(winner for winner, _ in lines(alone).values()) == ["", "", "a", "a"]
    two = held({"a": Robot(4, 0.0, lots, everywhere), "b": Robot(4, 0.0, {}, everywhere)})
    assert sorted(winner for winner, _ in lines(two).values()) == ["a", "a", "b", "b"]


def test_of_two_rounds_that_begin_at_the_same_time_all_hold_that_of_the_lower_name() -> None:
    team = Team(drawn(1, 4, 6), 0.2)
    team.begin("robot3")
    team.begin_too("robot1")
    team.run()
    assert {auction.id for auction in team.rounds.values()} == {RoundId(1, "robot1")}


def test_an_agent_whose_row_is_impossible_is_left_out_and_the_others_go_on() -> None:
    robots = {
        "a": Robot(2, 0.0, {"a/T": Lot(10.0)}, {"a/T": 3.0}),
        "b": Robot(2, 0.0, {}, {"a/T": 2.0}),
        "liar": Robot(),
    }
    team = Team(robots)
    team.begin("a")
    team.dead.add("liar")
    for seq in range(1, 200):
        for to in ("a", "b"):
            team.say("liar", to, Row(1, "a", seq=seq, at_most=1, costs={"a/T": math.nan}, bundle=("a/T",), asks=True))
        team.step()
    assert lines(team)["a/T"] == ("b", "")
    assert team.rounds["a"].report(["b", "liar"], team.now_s).ignored == {"liar": "its cost of a/T is nan"}


def test_a_claim_counts_only_as_far_as_the_costs_allow_that_its_agent_tells() -> None:
    auction = Round("a", RoundId(1, "a"), False, 1, 0.0, {"a/T": Lot(10.0, barred=("c",))}, 0.0)
    auction.price({"a/T": 3.0}, {}, 0.0)
    auction.take("b", Row(1, "a", seq=1, at_most=1, costs={"a/T": 9.0}, bundle=("a/T",)), 0.1)
    assert auction.winners() == {"a/T": ("a", 7.0)}
    auction.take("c", Row(1, "a", seq=1, at_most=1, costs={"a/T": 0.0}, bundle=("a/T",)), 0.1)
    assert auction.winners() == {"a/T": ("a", 7.0)}  # it has refused the task
    auction.take("b", Row(1, "a", seq=2, at_most=1, costs={"a/T": 1.0}, bundle=("a/T",)), 0.2)
    assert auction.winners() == {"a/T": ("b", 9.0)} and auction.row.bundle == ()


def test_an_older_row_changes_nothing() -> None:
    auction = Round("a", RoundId(1, "a"), False, 1, 0.0, {"a/T": Lot(10.0)}, 0.0)
    newer = Row(1, "a", seq=2, at_most=1, costs={"a/T": 0.0}, bundle=("a/T",))
    auction.take("b", newer, 0.1)
    auction.take("b", replace(newer, seq=1, bundle=()), 0.2)
    assert auction.winners() == {"a/T": ("b", 10.0)}


@pytest.mark.parametrize("cost", [math.nan, math.inf])
def test_a_cost_that_is_no_number_is_a_refusal(cost: float) -> None:
    """An infinite one says that the agent cannot reach the task."""
    auction = Round("a", RoundId(1, "a"), False, 1, 0.0, {"a/T": Lot(10.0)}, 0.0)
    auction.price({"a/T": cost}, {}, 0.0)
    assert auction.row.costs == {} and auction.unpriced() == []
    assert auction.row.refusals == {"a/T": f"its cost is {cost:g}"}
    (line,) = auction.report([], 0.0).lines
    assert (line.winner, line.reason) == ("", "no agent can take it")


def test_what_an_agent_claimed_that_has_gone_is_free() -> None:
    auction = Round("a", RoundId(1, "a"), False, 1, 0.0, {"a/T": Lot(10.0)}, 0.0)
    auction.price({"a/T": 3.0}, {}, 0.0)
    auction.take("b", Row(1, "a", seq=1, at_most=1, costs={"a/T": 0.0}, bundle=("a/T",)), 0.1)
    assert auction.row.bundle == ()
    auction.left("b", 0.2)
    assert auction.winners() == {"a/T": ("a", 7.0)}


def test_a_round_ends_although_an_agent_never_answers_again() -> None:
    team = Team(drawn(2, 3, 5), 0.0)
    team.begin("robot0")
    for _ in range(20):
        team.step()
    team.dead.add("robot2")
    assert team.run() < 7.0 and set(team.over) == {"robot0", "robot1"}


def test_an_agent_that_takes_no_part_is_named_and_holds_nobody_up() -> None:
    team = Team({**drawn(2, 3, 5), "zero": Robot()}, 0.0)
    team.dead.add("zero")
    team.begin("robot0")
    assert team.run() < 2.0
    assert team.rounds["robot0"].report(list(team.robots)[1:], team.now_s).silent == ("zero",)


def test_an_agent_that_claims_more_than_it_takes_gets_nothing() -> None:
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, {"a/T": Lot(10.0), "a/U": Lot(10.0)}, 0.0)
    auction.price({"a/T": 3.0, "a/U": 3.0}, {}, 0.0)
    greedy = Row(1, "a", seq=1, at_most=1, costs={"a/T": 0.0, "a/U": 0.0}, bundle=("a/T", "a/U"))
    auction.take("b", greedy, 0.1)
    assert {agent for agent, _ in auction.winners().values()} == {"a"}
    auction.take("b", replace(greedy, seq=2, bundle=("a/T",)), 0.2)  # it tells the truth again
    assert auction.winners() == {"a/T": ("b", 10.0), "a/U": ("a", 7.0)}
    assert auction.report(["b"], 0.3).ignored == {}


def test_a_round_waits_for_acknowledgements_and_prices_and_not_for_ever() -> None:
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, {"a/T": Lot(10.0)}, 0.0)
    assert not auction.tick(2.0)  # it does not know yet what the task costs here
    auction.price({"a/T": 3.0}, {}, 2.0)
    row = Row(1, "a", seq=1, costs={"a/T": 9.0})
    auction.take("b", row, 2.1)
    assert not auction.tick(4.0)  # b may bid for it, and has not heard of it
    assert [peer for peer, said in auction.due(["b"], 4.0) if said.asks] == ["b"]
    assert auction.due(["b"], 4.05) == []
    auction.take("b", replace(row, heard={"a": auction.row.seq}), 4.1)
    assert auction.agreed and auction.tick(4.2) and not auction.tick(4.3)
    silent = Round("a", RoundId(1, "a"), False, 2, 0.0, {}, 0.0)
    silent.take("b", row, 0.1)
    assert silent.tick(6.0) and not silent.report(["b"], 6.0).agreed


def test_a_round_waits_for_one_that_has_not_told_its_costs_yet() -> None:
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, {"a/T": Lot(10.0)}, 0.0)
    auction.price({"a/T": 3.0}, {}, 0.0)
    row = Row(1, "a", seq=1, at_most=1, heard={"a": 9})
    auction.take("b", row, 0.1)
    assert auction.agreed and not auction.tick(2.0)  # it imports the class, for example
    auction.take("b", replace(row, seq=2, refusals={"a/T": "lacks the device type gripper"}), 2.1)
    assert auction.tick(2.2)


def test_what_gains_the_team_nothing_does_not_migrate() -> None:
    """Two auctions may find two allocations that are as good: with the price of its moves, the other one is worse."""
    lots = {"a/T": Lot(10.0, 0.4), "a/U": Lot(10.0, 0.4)}
    robots = {"a": Robot(1, 0.0, lots, {"a/T": 2.0, "a/U": 1.0}), "b": Robot(1, 0.0, {}, {"a/T": 3.0, "a/U": 1.5})}
    first = held(robots)
    assert lines(first) == {"a/T": ("b", ""), "a/U": ("a", "")}
    # Now U is on b, and what it costs on a has fallen: the auction would exchange both tasks, for less than they cost.
    moved = {
        "a": Robot(1, 0.0, {"a/T": Lot(10.0, 0.4)}, {"a/T": 2.0, "a/U": 1.0}),
        "b": Robot(1, 0.0, {"a/U": Lot(10.0, 0.4)}, {"a/T": 2.9, "a/U": 1.5}),
    }
    second = held(moved)
    assert lines(second) == {"a/T": ("a", ""), "a/U": ("b", "")}


def test_numbers_that_are_too_high_to_be_added_are_left_out() -> None:
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, {"a/T": Lot(10.0)}, 0.0)
    auction.price({"a/T": 3.0}, {}, 0.0)
    huge = {f"b/{number}": Lot(1.5e308) for number in range(2)}
    auction.take("b", Row(1, "a", seq=1, at_most=2, lots=huge, costs=dict.fromkeys(huge, 0.0), bundle=tuple(huge)), 0.1)
    auction.take("c", Row(1, "a", seq=1, at_most=1, costs={"a/T": 1.5e308}), 0.1)
    report = auction.report(["b", "c"], 0.2)
    assert (report.value, report.ignored.keys()) == (7.0, {"b", "c"})
    auction.take("d", Row(1, "a", seq=1, lots={"d/T": Lot(10.0)}), 0.3)
    auction.price({"d/T": 1e300}, {}, 0.3)
    assert auction.row.refusals == {"d/T": "its cost is 1e+300, more than 1e+12"}


def test_of_what_a_peer_has_heard_only_the_own_row_is_kept() -> None:
    auction = Round("a", RoundId(1, "a"), False, 2, 0.0, {}, 0.0)
    for number in range(2000):
        auction.take("b", Row(1, "a", seq=1, heard={f"x{number}": 1}), 0.1)
    auction.take("b", Row(1, "a", seq=1, heard={"a": 9}), 0.1)
    assert auction.agreed
    auction.take("c", Row(1, "a", seq=1, heard={"a": 9}), 0.1)
    assert auction.market.rows["b"].heard == {"a": 9}
