"""The best allocation of a market, by mixed-integer programming: how good is what the team has agreed on? Pure.

It needs the extra `allocation` (`highspy`), and all that agents tell of themselves. No agent acts on it.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any, Final

from pancakes.durable.market import Market

MOST_NODES: Final = 20_000
"""The solver gives up after this many nodes of its search tree. A limit of time would give other results each time."""


def has_solver() -> bool:
    """Return whether the extra `allocation` is installed."""
    from importlib.util import find_spec

    return find_spec("highspy") is not None


def optimum_of(market: Market, limit_s: float | None = None) -> tuple[float, dict[str, list[str]]] | None:
    """Return what the best allocation is worth, and that allocation.

    Args:
        market: what there is to allocate.
        limit_s: how long to look for it; None: only the size of the search is limited.

    Returns:
        None: the extra `allocation` is not installed, or the problem is too large for the solver.
    """
    if not has_solver():
        return None
    import highspy

    class Quiet(highspy.Highs):  # type: ignore[misc, unused-ignore]
        """Print no banner: the standard output of an agent is its own."""

        def enableCallbacks(self) -> None:
            # The constructor calls this, and this is what prints it.
            self.setOptionValue("output_flag", False)
            super().enableCallbacks()

    solver = Quiet()
    solver.setOptionValue("output_flag", False)
    if limit_s is not None:
        solver.setOptionValue("time_limit", limit_s)
    solver.setOptionValue("threads", 1)
    solver.setOptionValue("mip_max_nodes", MOST_NODES)
    solver.setOptionValue("mip_rel_gap", 1e-9)
    lots, taken, served = market.lots, {}, {}
    for key in lots:
        for agent in market.rows:
            bid = market.bid(agent, key, 0)
            if bid is not None and market.rows[agent].at_most:
                taken[agent, key] = solver.addBinary(obj=bid)
        served[key] = solver.addBinary()
        solver.addConstr(_sum([it for (_, other), it in taken.items() if other == key]) - served[key] == 0)
    if not taken:
        return 0.0, {}
    for agent, row in market.rows.items():
        mine = [it for (other, _), it in taken.items() if other == agent]
        if mine:
            # The price of the place rises from one to the next, so they fill up from the first.
            places = [
                solver.addVariable(0.0, 1.0, -row.crowding * place) for place in range(min(row.at_most, len(mine)))
            ]
            solver.addConstr(_sum(mine) - _sum(places) == 0)
    for key, mate in _pairs(market):
        solver.addConstr(served[key] - served[mate] == 0)
        for agent in market.rows:
            both = [taken[agent, it] for it in (key, mate) if (agent, it) in taken]
            if len(both) == 2:
                solver.addConstr(both[0] + both[1] <= 1)
    if market.timed:
        _add_times(solver, market, taken, served)
    solver.maximize()
    if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
        return None
    bundles: dict[str, list[str]] = {}
    for (agent, key), variable in taken.items():
        if solver.val(variable) > 0.5:
            bundles.setdefault(agent, []).append(key)
    return market.value(bundles), bundles


def _sum(terms: list[Any]) -> Any:
    """Return the sum of variables of the solver."""
    total = 0.0
    for term in terms:
        total = total + term
    return total


def _pairs(market: Market) -> list[tuple[str, str]]:
    return [(key, mate) for key in market.lots for mate in market.mates[key] if key < mate]


def _add_times(solver: Any, market: Market, taken: dict[Any, Any], served: dict[str, Any]) -> None:
    """Add when each lot begins: after those before it, in time, and one after the other on each agent."""
    lots = market.lots
    # No lot begins later than all others together take.
    horizon_s = sum(it.lot.takes_s for it in lots.values())
    begins = {key: solver.addVariable(0.0, horizon_s) for key in lots}
    for key, offered in lots.items():
        lot = offered.lot
        if lot.ends_by_s is not None:
            slack_s = horizon_s + lot.takes_s + abs(lot.ends_by_s)
            solver.addConstr(begins[key] + lot.takes_s + slack_s * served[key] <= lot.ends_by_s + slack_s)
        for before in market.before[key]:
            solver.addConstr(served[key] - served[before] <= 0)
            reach_s = horizon_s + lots[before].lot.takes_s
            solver.addConstr(begins[before] - begins[key] + reach_s * served[key] <= reach_s - lots[before].lot.takes_s)
    busy = [key for key in lots if lots[key].lot.takes_s > 0]
    for one, other in combinations(busy, 2):
        first = solver.addBinary()
        one_s, other_s = lots[one].lot.takes_s, lots[other].lot.takes_s
        for agent in market.rows:
            if (agent, one) in taken and (agent, other) in taken:
                both = taken[agent, one] + taken[agent, other]
                reach_s = horizon_s + max(one_s, other_s)
                # If both are here, the other begins once this one is over; or the other way round.
                solver.addConstr(begins[one] - begins[other] + reach_s * both + reach_s * first <= 3 * reach_s - one_s)
                solver.addConstr(
                    begins[other] - begins[one] + reach_s * both - reach_s * first <= 2 * reach_s - other_s
                )
