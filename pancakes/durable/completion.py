"""What an auction leaves undone: an allocation is made allowed, complete and calm. Pure.

An auction adds one lot after the other, so it may miss a group that has to be allocated together, an order, or a
deadline that is kept only if another lot makes room. Once a round is over, each agent does the rest by itself: from
the same rows all come to the same allocation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from pancakes.durable.market import LEAST_GAIN, Market, in_time, timetable

Bundles = dict[str, list[str]]
"""The lots of each agent, in the order in which it added them."""

WORK: Final = 2_000
"""So much is tried: the number of timetables times that of the lots. It bounds the time that an agent thinks."""


def allowed(market: Market, won: Mapping[str, list[str]]) -> Bundles:
    """Return an allocation without what it would break: lots without a mate, and lots that are not over in time."""
    found = {agent: list(keys) for agent, keys in won.items()}
    while True:
        ends = timetable(market, found)
        has = {key for keys in found.values() for key in keys}
        gone = {
            key
            for key in has
            if not in_time(market.lots[key].lot, ends.get(key)) or any(it not in has for it in market.mates[key])
        }
        if not gone:
            return found
        found = {agent: [key for key in keys if key not in gone] for agent, keys in found.items()}


def completed(market: Market, won: Bundles) -> Bundles:
    """Return an allocation that also has what an auction misses, if that makes it better.

    Each lot that is coupled and has no agent is tried with all that it needs; if there is no place for them, one other
    lot after the other makes room, and finds another place or none.
    """
    search = _Search(market)
    better = True
    while better:
        better = False
        has = {key for keys in won.values() for key in keys}
        missing = [key for key in market.lots if key not in has and market.is_coupled(key)]
        for key in sorted(missing, key=lambda it: (-market.lots[it].lot.value, it)):
            group = _needed(market, key, has)
            found = search.with_group(won, group) if all(_is_possible(market, it) for it in group) else None
            if found is not None:
                won, better = found, True
                break
    return won


def calmed(market: Market, won: Bundles, present: Bundles) -> Bundles:
    """Return an allocation with fewer migrations and at least the same value.

    An auction finds a good allocation, not the best one. If costs differ a little from round to round, it may find
    another one that is as good, and tasks would migrate to and fro.

    Args:
        market: what there is to allocate.
        won: the allocation.
        present: the one in which each task stays where it is.
    """
    if market.value(present) >= market.value(won) and not market.faults(present):
        return present
    for key, offered in market.lots.items():
        agent = next((it for it, keys in won.items() if key in keys), offered.owner)
        if agent == offered.owner:
            continue
        back = {it: [other for other in keys if other != key] for it, keys in won.items()}
        back[offered.owner] = [*back[offered.owner], key]
        if market.value(back) >= market.value(won) and not market.faults(back):
            won = back
    return won


def _is_possible(market: Market, key: str) -> bool:
    lot = market.lots[key].lot
    return in_time(lot, lot.takes_s) and any(market.bid(agent, key, 0) is not None for agent in market.rows)


def _needed(market: Market, key: str, has: set[str]) -> list[str]:
    """Return the lots that have to be added with one: its mates and what comes before, first what comes first."""
    found: list[str] = []
    seen: set[str] = set()

    def add(one: str) -> None:
        if one in seen or one in has:
            return
        seen.add(one)
        for before in market.before[one]:
            add(before)
        found.append(one)
        for mate in market.mates[one]:
            add(mate)

    add(key)
    return found


class _Search:
    """Looks for places, and counts how much it has tried."""

    def __init__(self, market: Market) -> None:
        self._market = market
        self._left = WORK // max(1, len(market.lots))

    def with_group(self, won: Bundles, group: list[str]) -> Bundles | None:
        """Return a better allocation that has a group of lots too; None: none is found."""
        market = self._market
        least = market.value(won) + LEAST_GAIN
        found = self._placed(won, group)
        if found is not None and market.value(found) > least:
            return found
        best: Bundles | None = None
        for victim in [key for keys in won.values() for key in keys]:
            if self._left <= 0:
                break
            self._left -= 1
            without = allowed(market, {it: [key for key in keys if key != victim] for it, keys in won.items()})
            found = self._placed(without, group)
            if found is None:
                continue
            for key in [key for keys in won.values() for key in keys]:
                if all(key not in keys for keys in found.values()):
                    found = self._placed(found, [key]) or found
            if (value := market.value(found)) > least:
                best, least = found, value
        return best

    def _placed(self, won: Bundles, group: list[str]) -> Bundles | None:
        """Return an allocation with the lots of a group added, each where the bid is highest; None: there is none."""
        if not group:
            return won
        market, (key, *others) = self._market, group
        bids = []
        for agent, keys in won.items():
            bid = market.bid(agent, key, len(keys))
            if bid is not None and len(keys) < market.rows[agent].at_most and not set(keys) & set(market.mates[key]):
                bids.append((-bid, agent))
        for _, agent in sorted(bids):
            if self._left <= 0:
                return None
            self._left -= 1
            more = {**won, agent: [*won[agent], key]}
            ends = timetable(market, more)
            if all(in_time(market.lots[it].lot, ends.get(it)) for keys in more.values() for it in keys):
                found = self._placed(more, others)
                if found is not None:
                    return found
        return None
