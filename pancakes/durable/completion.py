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
CALMING: Final = 2_000_000
"""So much is done to avoid migrations: the number of lots that may stay times the steps of a timetable."""


def allowed(market: Market, won: Mapping[str, list[str]]) -> Bundles:
    """Return an allocation without what it would break: lots without a mate, and lots that are not over in time."""
    found = {agent: list(keys) for agent, keys in won.items()}
    while True:
        ends = timetable(market, found)
        has = {key for keys in found.values() for key in keys}
        left = {key for key in has if in_time(market.lots[key].lot, ends.get(key))}
        # All that needs a lot goes with it before the next timetable: in a long chain there would be one for each link.
        while alone := {key for key in left if any(it not in left for it in (*market.mates[key], *market.before[key]))}:
            left -= alone
        if left == has:
            return found
        found = {agent: [key for key in keys if key in left] for agent, keys in found.items()}


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
            if search.left <= 0:
                return won
            group = _needed(market, key, has, search.left)
            if len(group) > search.left or not all(_is_possible(market, it) for it in group):
                continue
            found = search.with_group(won, group)
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
    is_coupled = market.timed or any(market.mates.values())
    tries = CALMING // len(market.lots) ** (2 if is_coupled else 1) if market.lots else 0
    for key, offered in market.lots.items():
        agent = next((it for it, keys in won.items() if key in keys), offered.owner)
        if agent == offered.owner:
            continue
        if tries <= 0:
            break
        tries -= 1
        back = {it: [other for other in keys if other != key] for it, keys in won.items()}
        back[offered.owner] = [*back[offered.owner], key]
        if market.value(back) >= market.value(won) and not market.faults(back):
            won = back
    return won


def _is_possible(market: Market, key: str) -> bool:
    lot = market.lots[key].lot
    return in_time(lot, lot.takes_s) and any(market.bid(agent, key, 0) is not None for agent in market.rows)


def _needed(market: Market, key: str, has: set[str], most: int) -> list[str]:
    """Return the lots that have to be added with one: its mates and what comes before, first what comes first.

    If there are more than `most`, not all of them are returned, but more than `most`.
    """
    found: list[str] = []
    seen: set[str] = set()

    def add(one: str) -> None:
        if one in seen or one in has or len(seen) > most:
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
        self.left = WORK // max(1, len(market.lots))

    def with_group(self, won: Bundles, group: list[str]) -> Bundles | None:
        """Return a better allocation that has a group of lots too; None: none is found."""
        market = self._market
        least = market.value(won) + LEAST_GAIN
        found = self._placed(won, group)
        if found is not None and market.value(found) > least:
            return found
        best: Bundles | None = None
        for victim in [key for keys in won.values() for key in keys]:
            if self.left <= 0:
                break
            self.left -= 1
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
            if self.left <= 0:
                return None
            self.left -= 1
            more = {**won, agent: [*won[agent], key]}
            ends = timetable(market, more)
            if all(in_time(market.lots[it].lot, ends.get(it)) for keys in more.values() for it in keys):
                found = self._placed(more, others)
                if found is not None:
                    return found
        return None
