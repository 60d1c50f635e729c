"""One round of the team's allocation: a bundle auction by consensus, without a leader. Pure.

The algorithm is that of Choi, Brunet and How, *Consensus-Based Decentralized Auctions for Robust Task Allocation*
(CBBA, 2009). An agent adds the lot with the highest bid that nobody outbids to its bundle, again and again. If another
agent outbids it, it releases that lot and all that it added later, because their bids depended on it. The consensus
table has the newest row of each agent, by its sequence number. Unlike CBBA, no agent passes on what it heard of a third
one: it would have to be believed.

Packets may be lost, doubled, reordered and delayed: a row is said again until it is acknowledged. A round is over once
all agents that take part have each other's newest rows and nothing has changed for a while, or after its longest time.
What it came to is the word of the agent that has a task: only that one can migrate it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from heapq import heapify, heappop, heappush
from typing import Final

import msgspec
from msgspec.structs import replace

from pancakes.durable.completion import allowed, calmed, completed
from pancakes.durable.market import (
    LEAST_GAIN,
    MOST_LETTERS,
    AllocationReport,
    Lot,
    LotLine,
    Market,
    Row,
    fault_of_cost,
    fault_of_row,
    in_time,
    market_of,
    timetable,
)

MOST_AGENTS: Final = 256
"""Rows of at most this many other agents count."""
MOST_DROPPED: Final = 3
"""An agent that had to give a lot back this often, as others did not do their part of it, leaves it in this round."""
PLANNED: Final = 20_000
"""How many lots an agent plans at once, in all timetables that it tries for its bundle: meanwhile it answers nobody."""
PLANNED_PER_S: Final = 40_000
"""How many more it may plan with each host second; what it cannot try now, it tries in a later tick."""


class RoundTimes(msgspec.Struct, frozen=True):
    """How long the parts of a round take, in host seconds.

    Attributes:
        say_again_s: how often a row that is not acknowledged is said again.
        join_s: how long other agents have to take part.
        quiet_s: how long nothing must have changed.
        latest_s: how long a round takes at most.
    """

    say_again_s: float = 0.1
    join_s: float = 0.5
    quiet_s: float = 0.5
    latest_s: float = 6.0


TIMES: Final = RoundTimes()


class RoundId(msgspec.Struct, frozen=True):
    """Which round it is: of two, all agents join the later one.

    Attributes:
        number: higher than that of each round that its starter has heard of.
        starter: the agent that began it. Of two that begin at the same time, the one with the lower name counts.
    """

    number: int
    starter: str

    def is_later_than(self, other: RoundId) -> bool:
        """Return whether this round counts, and the other one does not any more."""
        return (-self.number, self.starter) < (-other.number, other.starter)


class Round:
    """The part of one agent in a round.

    Args:
        me: the agent.
        id: which round it is.
        dry_run: whether nothing is moved.
        at_most: how many lots the agent takes.
        crowding: what each lot in its bundle takes off its next bid.
        lots: what the agent puts up, by task.
        now_s: host time.
        times: how long the parts take.
    """

    def __init__(
        self,
        me: str,
        id: RoundId,
        dry_run: bool,
        at_most: int,
        crowding: float,
        lots: Mapping[str, Lot],
        now_s: float,
        times: RoundTimes = TIMES,
    ) -> None:
        self.me = me
        self.id = id
        self.dry_run = dry_run
        self._times = times
        self._began_s = self._changed_s = now_s
        self._ended_s: float | None = None
        self._ignored: dict[str, str] = {}
        self._dropped: dict[str, int] = {}
        self._answers: set[str] = set()  # the agents that want an answer
        self._hears: dict[str, frozenset[str]] = {}  # the agents that a peer hears of, by its newest row
        self._said_s: dict[str, float] = {}
        self._may_plan, self._planned_s = float(PLANNED), now_s
        self._is_behind = False  # whether its bundle is not what it would be, as it may plan no more for now
        row = Row(id.number, id.starter, dry_run, 1, at_most, crowding, dict(lots))
        self._rows = {me: row}
        self._market = market_of(self._rows)

    @property
    def over(self) -> bool:
        """Whether the agent is through with it; it still answers others."""
        return self._ended_s is not None

    @property
    def row(self) -> Row:
        """The agent's own row."""
        return self._rows[self.me]

    @property
    def market(self) -> Market:
        """What the agent knows of lots and other agents."""
        return self._market

    @property
    def agreed(self) -> bool:
        """Whether all agents that take part have each other's newest rows, as far as the agent knows."""
        return all(self._has_mine(peer) for peer in self._others())

    def unpriced(self) -> list[str]:
        """Return the lots of which the agent has not told yet what they would cost on it."""
        own = self.row
        return [key for key in self._market.lots if key not in own.costs and key not in own.refusals]

    def _is_priced(self) -> bool:
        """Return whether all have told what each lot costs on them: one may still import the class of a task."""
        rows = [row for agent, row in self._rows.items() if agent not in self._ignored]
        return all(key in row.costs or key in row.refusals for row in rows for key in self._market.lots)

    # What comes in ------------------------------------------------------------------------------------------------

    def price(self, found: Mapping[str, float], refused: Mapping[str, str], now_s: float) -> None:
        """Take what lots cost here, and why others cannot be taken. A cost that is none counts as a refusal."""
        if self.over or not (found or refused):
            return
        faults = {key: fault for key, cost in found.items() if (fault := fault_of_cost(cost))}
        own = self.row
        refusals = own.refusals | {key: why[:MOST_LETTERS] for key, why in (dict(refused) | faults).items()}
        costs = own.costs | {key: cost for key, cost in found.items() if key not in faults}
        self._rows[self.me] = replace(own, costs=costs, refusals=refusals)
        self._begin_again(now_s)

    def take(self, peer: str, row: Row, now_s: float) -> None:
        """Take a row of another agent in this round. An older one, or one with a fault, does not count."""
        if peer == self.me or (peer not in self._rows and len(self._rows) > MOST_AGENTS):
            return
        if row.asks:
            self._answers.add(peer)
        known = self._rows.get(peer)
        heard = row.heard.get(self.me, 0)  # which rows it has of others is not kept
        hears = frozenset(row.heard) if len(row.heard) <= MOST_AGENTS else frozenset()
        if known is not None and row.seq <= known.seq:
            if row.seq == known.seq:  # said again: it may have heard more
                self._hears[peer] |= hears
                self._rows[peer] = replace(known, heard={self.me: max(heard, known.heard.get(self.me, 0))})
            return
        if fault := fault_of_row(row):
            # It is left out with all that it told before: an agent that is wrong once is not half believed.
            self._ignored[peer] = fault[:MOST_LETTERS]
            row = Row(row.number, row.starter, seq=row.seq)
        elif peer in self._ignored:
            del self._ignored[peer]
        self._hears[peer] = hears
        self._rows[peer] = replace(row, heard={self.me: heard})
        if self.over:
            return
        if known is None or row.lots != known.lots:
            self._begin_again(now_s)
        else:
            self._market = msgspec.structs.replace(self._market, rows=dict(self._rows))
            self._bid(now_s)

    def answer(self, peer: str) -> None:
        """Have an agent told of this round: it speaks of an earlier one."""
        self._answers.add(peer)

    def left(self, peer: str, now_s: float) -> None:
        """Take the news that the link to an agent is gone: it has no part in this round any more."""
        if self._rows.pop(peer, None) is not None and not self.over:
            self._begin_again(now_s)

    # What goes out ------------------------------------------------------------------------------------------------

    def due(self, peers: Iterable[str], now_s: float) -> list[tuple[str, Row]]:
        """Return what to say now, and to whom: to be called after each change, and each `say_again_s`.

        Args:
            peers: the linked agents.
            now_s: host time.
        """
        heard = {peer: row.seq for peer, row in self._rows.items() if peer != self.me}
        said = []
        for peer in peers:
            late = now_s - self._said_s.get(peer, -math.inf) >= self._times.say_again_s - 1e-9
            # One that has never answered may be without allocation: it is told of the round while others may join.
            asks = not self._has_mine(peer) if peer in self._rows else now_s < self._began_s + self._times.join_s
            if peer in self._answers or (asks and late):
                self._said_s[peer] = now_s
                said.append((peer, replace(self.row, heard=heard, asks=asks)))
        self._answers.clear()
        return said

    def _has_mine(self, peer: str) -> bool:
        return self._rows[peer].heard.get(self.me, 0) >= self.row.seq

    def _all_hear_all(self) -> bool:
        """Return whether all that take part hear of the same agents: those that are not linked do not."""
        heard = (self._hears[peer] | {peer} for peer in self._others() if peer not in self._ignored)
        return all(names == self._rows.keys() for names in heard)

    def _others(self) -> list[str]:
        return [peer for peer in self._rows if peer != self.me]

    def tick(self, now_s: float) -> bool:
        """See whether the round is over; to be called each `say_again_s`. Return whether it is, for the first time."""
        if self.over:
            return False
        times = self._times
        if self._is_behind:
            self._bid(now_s)
        if now_s < self._began_s + times.latest_s:
            quiet = now_s >= max(self._changed_s + times.quiet_s, self._began_s + times.join_s)
            if not quiet or self._is_behind or not self.agreed or not self._is_priced():
                return False
            if alone := self._alone():
                # Others can use the places that a part of a group takes up.
                own = self.row
                self._rows[self.me] = replace(own, given_up=(*own.given_up, *alone))
                self._bid(now_s, changed=True)
                return False
        self._ended_s = now_s
        return True

    # The auction --------------------------------------------------------------------------------------------------

    def _begin_again(self, now_s: float) -> None:
        """Lots or costs are new: what was chosen without them may not be the best."""
        own, lots = self.row, market_of(self._rows).lots
        # There may be more tasks by now than a team allocates, and other ones are left out.
        costs = {key: cost for key, cost in own.costs.items() if key in lots}
        refusals = {key: why for key, why in own.refusals.items() if key in lots}
        self._rows[self.me] = replace(own, bundle=(), costs=costs, refusals=refusals)
        self._market = market_of(self._rows)
        self._bid(now_s, changed=True)

    def winners(self) -> dict[str, tuple[str, float]]:
        """Return the agent with the highest bid of each lot that is claimed, and its bid; of two, the lower name."""
        return self._best(self._rows)

    def _best(self, agents: Iterable[str]) -> dict[str, tuple[str, float]]:
        best: dict[str, tuple[str, float]] = {}
        market = self._market
        for agent in sorted(agents):
            for place, key in enumerate(self._rows[agent].bundle):
                bid = market.bid(agent, key, place) if key in market.lots else None
                if bid is not None and bid > LEAST_GAIN and (key not in best or bid > best[key][1]):
                    best[key] = agent, bid
        return best

    def _bid(self, now_s: float, changed: bool = False) -> None:
        """Release what is outbid, and add the lots with the highest bids."""
        own = self.row
        self._may_plan = min(PLANNED, self._may_plan + PLANNED_PER_S * (now_s - self._planned_s))
        self._planned_s = now_s
        bundle = own.bundle
        self._is_behind = self._may_plan <= 0
        if not self._is_behind:
            best = self._best(self._others())
            bundle = self._added(self._kept(bundle, best), best)
        if changed or bundle != own.bundle:
            self._changed_s = now_s
            self._rows[self.me] = replace(own, bundle=bundle, seq=own.seq + 1)
            self._market = msgspec.structs.replace(self._market, rows=dict(self._rows))

    def _added(self, bundle: tuple[str, ...], best: Mapping[str, tuple[str, float]]) -> tuple[str, ...]:
        """Return a bundle with the lots added that have the highest bids, of those that fit.

        One that does not fit does not fit into a larger bundle either, unless it waits for a lot that is added.
        """
        market, place = self._market, len(bundle)
        bids = [
            (-bid, key)
            for key in market.lots
            if key not in bundle and (bid := market.bid(self.me, key, place)) is not None and bid > LEAST_GAIN
        ]
        heapify(bids)
        waiting: dict[str, list[tuple[float, str]]] = {}
        while bids and len(bundle) < self.row.at_most:
            bid, key = heappop(bids)
            if self._winning(key, len(bundle), best) is None:
                continue
            nobody_has = next((it for it in market.before[key] if it not in best and it not in bundle), None)
            if nobody_has is not None:
                waiting.setdefault(nobody_has, []).append((bid, key))
                continue
            if self._may_plan <= 0:
                self._is_behind = True
                break
            if self._fits(key, bundle, best):
                bundle = (*bundle, key)
                for other in waiting.pop(key, ()):
                    heappush(bids, other)
        return bundle

    def _winning(self, key: str, place: int, best: Mapping[str, tuple[str, float]]) -> float | None:
        """Return the agent's bid for a lot; None: it makes none, or another one is higher."""
        bid = self._market.bid(self.me, key, place)
        if bid is None or bid <= LEAST_GAIN or self._is_given_up(key):
            return None
        other, highest = best.get(key, ("", -math.inf))
        return bid if bid > highest or (bid == highest and self.me < other) else None

    def _kept(self, bundle: tuple[str, ...], best: Mapping[str, tuple[str, float]]) -> tuple[str, ...]:
        """Return the bundle up to the first lot that is outbid, or that others make impossible."""
        count = 0
        for key in bundle:
            if key not in self._market.lots or self._winning(key, count, best) is None:
                break
            count += 1
        least, most = 0, count
        while least < most:  # all of it is tried first: mostly nothing has become impossible
            tried = most if most == count else (least + most + 1) // 2
            if self._is_possible(bundle[:tried], best):
                least = tried
            else:
                most = tried - 1
        if least < count:
            self._dropped[bundle[least]] = self._dropped.get(bundle[least], 0) + 1
        return bundle[:least]

    def _fits(self, key: str, bundle: tuple[str, ...], best: Mapping[str, tuple[str, float]]) -> bool:
        """Return whether a lot can be added to a bundle: no mate is in it, and all are over in time."""
        if self._dropped.get(key, 0) >= MOST_DROPPED or any(mate in bundle for mate in self._market.mates[key]):
            return False
        return self._is_possible((*bundle, key), best)

    def _is_possible(self, mine: tuple[str, ...], best: Mapping[str, tuple[str, float]]) -> bool:
        """Return whether all lots of a bundle are over in time, as far as is known of what others claim."""
        market = self._market
        if not market.timed:
            return True
        bundles: dict[str, list[str]] = {self.me: list(mine)}
        if any(market.lots[it].lot.after for it in mine):  # else it does not matter what others work at
            for other, (agent, _) in best.items():
                if other not in mine:
                    bundles.setdefault(agent, []).append(other)
        self._may_plan -= sum(map(len, bundles.values()))
        ends = timetable(market, bundles)
        return all(in_time(market.lots[it].lot, ends.get(it)) for it in mine)

    def _is_given_up(self, key: str) -> bool:
        given_up = any(key in row.given_up for row in self._rows.values())
        if not given_up:
            return False
        # The word of one agent is not enough: as far as is known here, a mate must be without an agent.
        return key in self.row.given_up or self._lacks_mate(key, self.winners())

    def _lacks_mate(self, key: str, winners: Mapping[str, object]) -> bool:
        return any(mate not in winners for mate in self._market.mates[key])

    def _alone(self) -> list[str]:
        """Return what the agent claims although a mate of it has no agent."""
        winners = self.winners()
        return [key for key in self.row.bundle if self._lacks_mate(key, winners)]

    # The account --------------------------------------------------------------------------------------------------

    def bundles(self) -> dict[str, list[str]]:
        """Return the allocation: what each agent has won, what an auction misses, less what gains the team nothing."""
        winners, market = self.winners(), self._market
        won = allowed(
            market,
            {
                agent: [key for key in row.bundle if winners.get(key, ("",))[0] == agent]
                for agent, row in self._rows.items()
            },
        )
        if self.agreed and self._all_hear_all():  # else others know other rows, and would come to something else
            won = completed(market, won)
        return calmed(market, won, self._present())

    def _present(self) -> dict[str, list[str]]:
        """Return the allocation in which each task stays where it is, if its agent can tell what it costs there."""
        present: dict[str, list[str]] = {agent: [] for agent in self._rows}
        for key, offered in self._market.lots.items():
            if self._market.cost(offered.owner, key) is not None:
                present[offered.owner].append(key)
        return present

    def report(self, neighbours: Collection[str], now_s: float) -> AllocationReport:
        """Return the account.

        Args:
            neighbours: the linked agents that could have taken part.
            now_s: host time.
        """
        market, bundles = self._market, self.bundles()
        winners = {key: (agent, place) for agent, keys in bundles.items() for place, key in enumerate(keys)}
        claims, ends = self.winners(), timetable(market, bundles)
        lines = [self._line(key, *winners.get(key, ("", 0)), claims, ends) for key in market.lots]
        for key, why in market.left_out.items():
            owner = next(agent for agent, row in sorted(self._rows.items()) if key in row.lots)
            lines.append(LotLine(key, owner, "", {}, {}, reason=why))
        return AllocationReport(
            self.id.number,
            self.id.starter,
            self.dry_run,
            tuple(sorted(lines, key=lambda it: it.task)),
            market.value(bundles),
            market.value(self._present()),
            None,
            self.agreed,
            dict(sorted(self._ignored.items())),
            tuple(sorted(it for it in neighbours if it not in self._rows)),
            (self._ended_s if self._ended_s is not None else now_s) - self._began_s,
        )

    def _line(
        self, key: str, winner: str, place: int, claims: Mapping[str, object], ends: Mapping[str, float]
    ) -> LotLine:
        market = self._market
        bids, refusals = {}, {}
        for agent in sorted(self._rows):
            bid = market.bid(agent, key, 0)
            if bid is not None:
                bids[agent] = bid
            elif agent in market.lots[key].lot.barred:
                refusals[agent] = "it has just refused the task"
            else:
                refusals[agent] = self._rows[agent].refusals.get(key, "it tells no cost")
        reason = "" if winner else self._why_nobody(key, bids, claims)
        over_s = ends.get(key) if market.timed and winner else None
        bid = market.bid(winner, key, place) if winner else None
        return LotLine(key, market.lots[key].owner, winner, bids, refusals, bid, over_s, reason)

    def _why_nobody(self, key: str, bids: Mapping[str, float], claims: Mapping[str, object]) -> str:
        if not bids:
            return "no agent can take it"
        if max(bids.values()) <= LEAST_GAIN:
            return "it costs each agent more than it is worth"
        lacking = [mate for mate in self._market.mates[key] if mate not in claims]
        if lacking:
            return f"{lacking[0]} finds no agent at the same time"
        lot = self._market.lots[key].lot
        if self._market.timed and (lot.ends_by_s is not None or lot.after):
            return "no agent with a place left can end it in time"
        return "no agent that can take it has a place left"
