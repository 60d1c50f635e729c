"""What an auction leaves undone: an allocation is made allowed, complete and calm. Pure.

An auction adds one lot after the other, so it may miss a group that has to be allocated together, an order, or a
deadline that is kept only if another lot makes room. Once a round is over, each agent does the rest by itself: from
the same rows all come to the same allocation.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import combinations
from typing import Final

from pancakes.durable.market import LEAST_GAIN, Market, in_time, timetable

Bundles = dict[str, list[str]]
"""The lots of each agent, in the order in which it added them."""

WORK: Final = 500_000
"""How much is tried: the number of timetables times their steps. It bounds how long an agent thinks."""
MOST_TRIES: Final = 2_000
"""Not more timetables are tried, however small the team is."""
BIDS: Final = 1_000
"""Comparing the bids of this many pairs of lots counts as much as trying a timetable."""
GROUP_TRIES: Final = 50
"""How many timetables are tried for lots that need each other."""
MOST_GROUP: Final = 32
"""More lots than this that need each other are not looked at."""
CALMING: Final = 2_000_000
"""How much is done to avoid migrations: the number of lots that may stay times the steps of a timetable."""


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

    It is searched for in the neighbourhood of the one that was won: some lots are taken back, and are given away again
    with those that have no agent, coupled lots together with all that they need. That is done with each lot that is
    coupled and has no agent, with each agent's bundle, and with pairs of lots, as long as something gets better. A team
    whose lots are not coupled is done with the auction.
    """
    if not any(map(market.is_coupled, market.lots)):
        return won
    search = _Search(market)
    won = {agent: won[agent] for agent in sorted(won)}  # all agents look in the same order
    while (found := search.better(won)) is not None:
        won = found
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


def _needed(market: Market, key: str, has: set[str]) -> list[str]:
    """Return the lots that have to be added with one: its mates and what comes before, first what comes first.

    If there are more than `MOST_GROUP`, not all of them are returned, but more than `MOST_GROUP`.
    """
    found: list[str] = []
    seen: set[str] = set()

    def add(one: str) -> None:
        if one in seen or one in has or len(seen) > MOST_GROUP:
            return
        seen.add(one)
        for before in market.before[one]:
            add(before)
        found.append(one)
        for mate in market.mates[one]:
            add(mate)

    add(key)
    return found


def _with(keys: list[str], place: int, key: str) -> list[str]:
    return [*keys[:place], key, *keys[place + 1 :]]


class _Search:
    """Looks for better allocations, and counts how much it has tried."""

    def __init__(self, market: Market) -> None:
        self._market = market
        self.left = min(MOST_TRIES, WORK // len(market.lots) ** 2)
        self._until = 0  # a group may be tried down to here

    def better(self, won: Bundles) -> Bundles | None:
        """Return the first better allocation; None: none is found."""
        if (found := self._exchanged(won)) is not None:
            return found
        least = self._market.value(won) + LEAST_GAIN
        for back, first in self._ways(won):
            if self.left <= 0:
                return None
            self.left -= 1
            found = self._given_again(won, back, first)
            if self._market.value(found) > least:
                return found
        return None

    def _exchanged(self, won: Bundles) -> Bundles | None:
        """Return an allocation in which two agents exchange two lots, and that is better; None: none is."""
        market = self._market
        held = [(agent, place, key) for agent, keys in won.items() for place, key in enumerate(keys)]
        self.left -= len(held) ** 2 // BIDS
        for (one, at, mine), (other, there, yours) in combinations(held, 2):
            if one == other or self.left <= 0:
                continue
            now = (market.bid(one, mine, at) or 0.0) + (market.bid(other, yours, there) or 0.0)
            here, away = market.bid(one, yours, at), market.bid(other, mine, there)
            if here is None or away is None or here + away <= now + LEAST_GAIN:
                continue
            self.left -= 1
            found = {**won, one: _with(won[one], at, yours), other: _with(won[other], there, mine)}
            if not market.faults(found):
                return found
        return None

    def _ways(self, won: Bundles) -> Iterator[tuple[Collection[str], str]]:
        """Yield which lots are taken back, and which one to give away first; empty: none in particular."""
        has = [key for keys in won.values() for key in keys]
        missing = self._by_value(self._market.lots.keys() - set(has))
        bundles = [keys for keys in won.values() if keys]
        for first in missing:
            yield (), first
        for first in missing:
            yield from (((key,), first) for key in has)
        for first in missing:
            yield from ((keys, first) for keys in bundles)
        yield from ((keys, "") for keys in bundles)
        yield from (((key,), "") for key in has)
        yield from ((keys, "") for keys in combinations(has, 2))

    def _by_value(self, keys: Iterable[str]) -> list[str]:
        return sorted(keys, key=lambda it: (-self._market.lots[it].lot.value, it))

    def _given_again(self, won: Bundles, back: Collection[str], first: str) -> Bundles:
        """Return an allocation in which some lots are taken back, and all that have no agent are given away."""
        market = self._market
        found = {agent: [key for key in keys if key not in back] for agent, keys in won.items()}
        found = allowed(market, found) if back else found
        has = {key for keys in found.values() for key in keys}
        missing = self._by_value(market.lots.keys() - has)
        for key in [first, *missing] if first else missing:
            if key in has or self.left <= 0:
                continue
            group = _needed(market, key, has)
            if len(group) > MOST_GROUP or not all(_is_possible(market, it) for it in group):
                continue
            self._until = self.left - GROUP_TRIES
            more = self._placed(found, group)
            if more is not None and (key == first or market.value(more) > market.value(found)):
                found = more
                has.update(group)
        return found

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
            if self.left <= max(0, self._until):
                return None
            self.left -= 1
            more = {**won, agent: [*won[agent], key]}
            ends = timetable(market, more)
            if all(in_time(market.lots[it].lot, ends.get(it)) for keys in more.values() for it in keys):
                found = self._placed(more, others)
                if found is not None:
                    return found
        return None
