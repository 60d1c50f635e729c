"""Bidding: whom to ask, how long to wait, whom to choose, and the account of it."""

from __future__ import annotations

import math

import pytest

from pancakes.control import Refusal
from pancakes.durable.messages import Solicit
from pancakes.durable.negotiation import Awarded, Exhausted, Negotiation
from pancakes.durable.record import TaskId
from pancakes.migration import Line

REQUEST = Solicit(TaskId("agent1", "ScanTarget"), 1, "encirclement.ScanTarget", "0.1.0", "client", ("pose", "motors"))


def negotiation(*neighbours: str, to: str = "", dry_run: bool = False) -> Negotiation:
    return Negotiation(
        REQUEST, "agent1", "rule", neighbours, 100.0, to, dry_run, window_s=0.5, patience_s=8.0, cause=""
    )


def message_of(outcome: object) -> str:
    assert isinstance(outcome, Exhausted) and outcome.error is not None
    return str(outcome.error)


def test_the_paper_s_move_the_sensor_refuses_and_the_reserve_robot_wins() -> None:
    bidding = negotiation("sensor", "agent2")
    assert bidding.asked == ("agent2", "sensor")
    assert bidding.begin(100.0) is None

    assert bidding.refuse("sensor", Refusal("unsupported", "lacks the device type motors"), 100.01) is None
    # All have answered: nobody waits for the end of the window.
    assert bidding.bid("agent2", 0.0, {"active tasks": 0.0}, 100.02) == Awarded("agent2")
    bidding.moved("agent2", 100.4)

    ledger = bidding.ledger(200.0)
    assert (ledger.task_id, ledger.source, ledger.outcome, ledger.winner) == (
        "agent1/ScanTarget",
        "agent1",
        "moved",
        "agent2",
    )
    assert ledger.duration_s == pytest.approx(0.4)
    assert ledger.lines == (
        Line("agent2", "bid", "won", 0.0, {"active tasks": 0.0}),
        Line("sensor", "refused", "refused", reason="lacks the device type motors", code="unsupported"),
    )


def test_the_cheapest_wins_and_ties_go_by_name() -> None:
    bidding = negotiation("c", "b", "a")
    bidding.bid("c", 1.0, {}, 100.1)
    bidding.bid("b", 1.0, {}, 100.1)
    assert bidding.bid("a", 2.0, {}, 100.1) == Awarded("b")

    assert [(line.peer, line.fate, line.reason) for line in bidding.ledger(101.0).lines] == [
        ("a", "lost", "b is cheaper"),
        ("b", "won", ""),
        ("c", "lost", "b has the same cost and a lower name"),
    ]


def test_where_a_neighbour_has_bid_no_other_is_waited_for_long() -> None:
    bidding = negotiation("a", "b")
    bidding.bid("b", 3.0, {}, 100.1)
    assert bidding.tick(100.4) is None
    assert bidding.tick(100.5) == Awarded("b")
    assert bidding.ledger(101.0).lines[0] == Line("a", "silent", "silent", reason="did not answer within 0.5 s")


def test_where_none_has_bid_a_silent_neighbour_is_waited_for() -> None:
    bidding = negotiation("a", "b", "c")
    bidding.refuse("b", Refusal("unsupported", "lacks the device type motors"), 100.1)
    assert bidding.tick(100.5) is None
    assert bidding.bid("a", 3.0, {}, 104.0) == Awarded("a"), "it is late for others to bid as well"
    assert bidding.ledger(105.0).lines == (
        Line("a", "bid", "won", 3.0, {}),
        Line("b", "refused", "refused", reason="lacks the device type motors", code="unsupported"),
        Line("c", "silent", "silent", reason="did not answer within 0.5 s"),
    )


def test_a_bid_within_the_window_is_compared_with_those_that_come_within_it() -> None:
    bidding = negotiation("a", "b", "c")
    assert bidding.bid("a", 3.0, {}, 100.2) is None
    assert bidding.bid("b", 1.0, {}, 100.49) is None
    assert bidding.tick(100.5) == Awarded("b")


def test_no_neighbour_is_waited_for_without_end() -> None:
    bidding = negotiation("a", "b")
    bidding.refuse("b", Refusal("unsupported", "knows no such type"), 103.0)
    assert bidding.tick(107.9) is None
    text = message_of(bidding.tick(108.0))
    assert text == "no neighbour can take ScanTarget: a: did not answer within 8 s; b: knows no such type"
    assert bidding.bid("a", 1.0, {}, 108.1) is None
    assert bidding.ledger(109.0).lines[0] == Line("a", "refused", "refused", 1.0, {}, "answered later than 8 s")


@pytest.mark.parametrize(
    ("cost", "terms", "why"),
    [
        (math.nan, {}, "its cost is nan"),
        (math.inf, {}, "its cost is inf"),
        (-1.0, {}, "its cost is negative (-1)"),
        (1.0, {"load": math.nan}, "its load is nan"),
    ],
)
def test_a_bid_that_cannot_be_compared_is_a_refusal(cost: float, terms: dict[str, float], why: str) -> None:
    assert message_of(negotiation("a").bid("a", cost, terms, 100.1)) == (
        f"no neighbour can take ScanTarget: a: its bid does not count: {why}"
    )


def test_a_late_bid_is_a_refusal() -> None:
    bidding = negotiation("a", "b")
    bidding.bid("b", 3.0, {}, 100.1)
    # The bid itself shows that the window is over.
    assert bidding.bid("a", 1.0, {}, 100.6) == Awarded("b")
    assert bidding.ledger(101.0).lines[0] == Line("a", "refused", "refused", 1.0, {}, "answered later than 0.5 s")


def test_a_bid_after_the_decision_changes_nothing() -> None:
    bidding = negotiation("a", "b")
    bidding.bid("b", 3.0, {}, 100.1)
    bidding.tick(100.5)
    assert bidding.bid("a", 1.0, {}, 100.6) is None
    assert bidding.chosen == "b"
    assert message_of(bidding.failed("b", Refusal("unable", "the link broke"), 101.0)).endswith(
        "a: answered later than 0.5 s; b: the link broke"
    )


def test_the_first_answer_counts() -> None:
    bidding = negotiation("a", "b")
    bidding.bid("a", 1.0, {}, 100.1)
    bidding.refuse("a", Refusal("unsupported", "changed its mind"), 100.2)
    assert bidding.bid("b", 2.0, {}, 100.3) == Awarded("a")


def test_answers_of_those_who_were_not_asked_are_ignored() -> None:
    bidding = negotiation("a", "b", to="b")
    assert bidding.bid("a", 0.0, {}, 100.1) is None
    assert bidding.bid("b", 9.0, {}, 100.1) == Awarded("b")


def test_where_the_hand_off_fails_the_next_bidder_is_tried_until_there_is_none() -> None:
    bidding = negotiation("a", "b")
    bidding.bid("a", 1.0, {}, 100.1)
    assert bidding.bid("b", 2.0, {}, 100.1) == Awarded("a")

    assert bidding.failed("b", Refusal("unable", "not yet its turn"), 100.2) is None
    silent = Refusal("unable", "did not answer the reservation in time")
    assert bidding.failed("a", silent, 101.1) == Awarded("b")
    text = message_of(bidding.failed("b", Refusal("busy", "its plug-in fails to load", 1.5), 101.2))

    assert text == (
        "no neighbour can take ScanTarget: a: did not answer the reservation in time; b: its plug-in fails to load"
    )
    ledger = bidding.ledger(200.0)
    assert (ledger.outcome, ledger.winner) == ("stayed", "")
    assert [(line.fate, line.code, line.retry_after_s) for line in ledger.lines] == [
        ("failed", "unable", None),
        ("failed", "busy", 1.5),
    ]


def test_without_neighbours_it_is_decided_at_once() -> None:
    unlinked = "(are their addresses in `peers` of [agent]?)"
    assert message_of(negotiation().begin(100.0)).endswith(unlinked)
    assert message_of(negotiation(to="agent9").begin(100.0)).endswith(unlinked)
    assert message_of(negotiation("a", to="agent9").begin(100.0)).endswith("agent9 is not linked to agent1, only a")
    mistyped = message_of(negotiation("agent2", to="agnt2").begin(100.0))
    assert mistyped.endswith("agnt2 is not linked to agent1, did you mean 'agent2'?")


def test_to_the_agent_that_has_it_is_no_migration() -> None:
    source = negotiation().ledger(100.0).source
    assert (
        message_of(negotiation("a", to=source).begin(100.0)) == f"ScanTarget is on {source} already: name another agent"
    )


def test_a_dry_run_compares_and_moves_nothing() -> None:
    bidding = negotiation("a", "b", dry_run=True)
    bidding.refuse("a", Refusal("unsupported", "lacks the device type motors"), 100.1)
    assert bidding.bid("b", 2.0, {"active tasks": 2.0}, 100.1) == Exhausted(None)
    ledger = bidding.ledger(101.0)
    assert (ledger.outcome, ledger.winner) == ("dry run", "b")
