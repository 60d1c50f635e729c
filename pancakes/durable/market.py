"""Which agent is to have which task: what each tells about that, what an allocation is worth, and the account. Pure.

In a round of the team's allocation (`auction`) each agent tells a **row**: the tasks that it puts up (**lots**), what
each lot would cost on it, and its **bundle**, the lots that it claims. Nobody sends a bid. All compute the bid of an
agent from its row by `bid_of`, so an agent cannot bid more than its costs allow, and tells nothing about others.

A bid falls with each lot in the bundle (`crowding`) and never rises. A lot that would have to move pays its
`move_price`: a gain that is smaller moves nothing, so the allocation does not oscillate.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from heapq import heapify, heappop, heappush
from typing import Annotated, Final

import msgspec

from pancakes.durable.messages import Solicit
from pancakes.migration import MOST_UNITS, fault_of
from pancakes.packet import packet_type

MOST_LOTS: Final = 512
"""Most lots of a team, and so most costs in a row."""
TOO_MANY: Final = f"a team allocates at most {MOST_LOTS} tasks"
"""Why a lot is left out: the first ones by their names count."""
MOST_TAKEN: Final = 256
"""Most tasks that an agent may take."""
MOST_NUMBER: Final = 2**40
"""The highest number of a round; the next one after it is 1."""
DEARER: Final = 2.0
"""Each migration of a task multiplies the price of the next one, until it has stayed for a while."""
MOST_LETTERS: Final = 200
"""Most letters of a reason."""
LEAST_GAIN: Final = 1e-9
"""A bid that is not higher than this gains nothing."""
_Key = Annotated[str, msgspec.Meta(max_length=512)]


class Lot(msgspec.Struct, frozen=True):
    """A task that is put up by the agent that has it.

    Attributes:
        value: what it is worth that an agent has the task, in the unit of its cost.
        move_price: what a migration costs in addition.
        takes_s: how long an agent works at it, one such task after the other; 0: it runs beside others.
        ends_by_s: when it has to be over, in seconds from the beginning of the round; None: at no time.
        after: names of tasks that must be over before it begins. One that nobody puts up is over.
        together: names of tasks that other agents must have at the same time; all of them are allocated, or none.
        barred: agents that do not get it, because they have just refused it.
        request: what an agent must know to tell its cost; None: it knows that already.
    """

    value: float
    move_price: float = 0.0
    takes_s: float = 0.0
    ends_by_s: float | None = None
    after: tuple[_Key, ...] = ()
    together: tuple[_Key, ...] = ()
    barred: tuple[_Key, ...] = ()
    request: Solicit | None = None


@packet_type("allocation.row")
class Row(msgspec.Struct, frozen=True):
    """What an agent tells in a round; about itself only.

    Attributes:
        number: the number of the round; of two rounds the one with the higher number counts, then the one with the
            lower `starter`.
        starter: the agent that began it.
        dry_run: whether nothing is moved.
        seq: the number of the row; the newest row of an agent counts.
        at_most: how many lots it takes.
        crowding: what each lot in its bundle takes off its next bid.
        lots: what it puts up, by task (`birthplace/name`).
        costs: what each lot would cost on it; those that are missing, it cannot take.
        refusals: why it cannot take a lot.
        bundle: the lots that it claims, in the order in which it added them.
        given_up: lots that it gave back because not all of their group found an agent.
        heard: the newest row that it has of each other agent.
        asks: whether the receiver is to answer, as it may not have this row yet.
    """

    number: Annotated[int, msgspec.Meta(ge=1, le=MOST_NUMBER)]
    starter: _Key
    dry_run: bool = False
    seq: Annotated[int, msgspec.Meta(ge=0, le=2**53)] = 0
    at_most: int = 0
    crowding: float = 0.0
    lots: dict[_Key, Lot] = msgspec.field(default_factory=dict)
    costs: dict[_Key, float] = msgspec.field(default_factory=dict)
    refusals: dict[_Key, str] = msgspec.field(default_factory=dict)
    bundle: tuple[_Key, ...] = ()
    given_up: tuple[_Key, ...] = ()
    heard: dict[_Key, int] = msgspec.field(default_factory=dict)
    asks: bool = False


def fault_of_row(row: Row) -> str:
    """Return why a row does not count, as a phrase; empty: it does."""
    if not 0 <= row.at_most <= MOST_TAKEN:
        return f"it would take {row.at_most} tasks, not 0 to {MOST_TAKEN}"
    if not 0 <= row.crowding <= MOST_UNITS:
        return f"its crowding is {row.crowding:g}"
    if max(len(row.lots), len(row.costs), len(row.refusals), len(row.given_up), len(row.heard)) > MOST_LOTS:
        return f"it names more than {MOST_LOTS} tasks or agents"
    for key, cost in row.costs.items():
        if fault := fault_of_cost(cost, f"cost of {key}"):
            return fault
    for key, lot in row.lots.items():
        if fault := fault_of_lot(lot):
            return f"{key}: {fault}"
    if len(row.bundle) > row.at_most:
        return f"it claims {len(row.bundle)} tasks, and takes at most {row.at_most}"
    if len(set(row.bundle)) < len(row.bundle):
        return "it claims a task twice"
    unpriced = [key for key in row.bundle if key not in row.costs]
    return f"it claims {unpriced[0]} and tells no cost of it" if unpriced else ""


def fault_of_cost(cost: float, name: str = "cost") -> str:
    """Return why a cost does not count, as a phrase; empty: it does."""
    fault = fault_of(cost, {}).replace("cost", name, 1)
    return fault or ("" if cost <= MOST_UNITS else f"its {name} is {cost:g}, more than {MOST_UNITS:g}")


def fault_of_lot(lot: Lot) -> str:
    """Return what is wrong with a lot, as a phrase; empty: nothing."""
    if not 0 < lot.value <= MOST_UNITS:
        return f"value must be a number > 0 and at most {MOST_UNITS:g}, not {lot.value:g}"
    for name, number in (("move_price", lot.move_price), ("takes_s", lot.takes_s)):
        if not 0 <= number <= MOST_UNITS:
            return f"{name} must be a number from 0 to {MOST_UNITS:g}, not {number:g}"
    if lot.ends_by_s is not None and not abs(lot.ends_by_s) <= MOST_UNITS:
        return f"ends_by_s must be a number of at most {MOST_UNITS:g} either way, not {lot.ends_by_s:g}"
    return ""


def moved_again_price(lot: Lot) -> float:
    """Return what the next migration of a task costs that has just migrated: each one makes it dearer."""
    return DEARER * lot.move_price


def name_of(key: str) -> str:
    """Return the name of a task `birthplace/name`."""
    return key.rpartition("/")[2]


class Offered(msgspec.Struct, frozen=True):
    """A lot, and the agent that has the task."""

    lot: Lot
    owner: str


def bid_of(offered: Offered, agent: str, cost: float, place: int, crowding: float) -> float:
    """Return what an agent bids for a lot.

    Args:
        offered: the lot.
        agent: the agent.
        cost: what the task would cost there.
        place: how many lots are in its bundle already.
        crowding: what each of those takes off.
    """
    moves = offered.lot.move_price if agent != offered.owner else 0.0
    return offered.lot.value - cost - crowding * place - moves


# The problem as a whole -------------------------------------------------------------------------------------------


class Market(msgspec.Struct, frozen=True):
    """All that is known of lots and agents: what to allocate.

    Attributes:
        lots: the lots, by task.
        rows: the rows that count, by agent.
        left_out: why a lot is not allocated, by task.
        mates: the lots that must be allocated together with a lot, to other agents; in both directions.
        before: the lots that must be over before a lot begins.
        timed: whether it matters when a task is worked at.
    """

    lots: dict[str, Offered]
    rows: dict[str, Row]
    left_out: dict[str, str]
    mates: dict[str, tuple[str, ...]]
    before: dict[str, tuple[str, ...]]
    timed: bool

    def is_coupled(self, key: str) -> bool:
        """Return whether more than costs and places decides who can have a lot."""
        return bool(self.mates[key] or self.before[key] or self.lots[key].lot.ends_by_s is not None)

    def cost(self, agent: str, key: str) -> float | None:
        """Return what a lot costs on an agent; None: it does not get it there."""
        if agent in self.lots[key].lot.barred:
            return None
        return self.rows[agent].costs.get(key)

    def bid(self, agent: str, key: str, place: int) -> float | None:
        """Return the bid of an agent for a lot; None: it cannot take it."""
        cost = self.cost(agent, key)
        return None if cost is None else bid_of(self.lots[key], agent, cost, place, self.rows[agent].crowding)

    def value(self, bundles: Mapping[str, Collection[str]]) -> float:
        """Return what an allocation is worth: the sum of all bids in it. The order within a bundle does not matter."""
        bids = (self.bid(agent, key, place) for agent, keys in bundles.items() for place, key in enumerate(keys))
        return math.fsum(bid for bid in bids if bid is not None)

    def faults(self, bundles: Mapping[str, Collection[str]]) -> list[str]:
        """Return what an allocation breaks, as sentences; empty: it is allowed."""
        taken = [(key, agent) for agent, keys in bundles.items() for key in keys]
        agents = dict(taken)
        found = [f"{agent} cannot take {key}" for key, agent in taken if self.cost(agent, key) is None]
        found += [f"{it} has too many" for it, keys in bundles.items() if len(keys) > self.rows[it].at_most]
        if len(agents) < len(taken):
            found.append("a task is allocated twice")
        for key, agent in taken:
            for mate in self.mates[key]:
                if agents.get(mate, agent) == agent:
                    found.append(f"{key} needs {mate} on another agent")
        ends = timetable(self, bundles)
        return found + [
            f"{key} is not over in time" for key, _ in taken if not in_time(self.lots[key].lot, ends.get(key))
        ]


def market_of(rows: Mapping[str, Row]) -> Market:
    """Return the market that rows describe. Those with a fault (`fault_of_row`) are expected to be left out before."""
    lots: dict[str, Offered] = {}
    left_out: dict[str, str] = {}
    for agent in sorted(rows):
        for key, lot in rows[agent].lots.items():
            if key in lots:
                left_out[key] = f"both {lots[key].owner} and {agent} say that they have it"
            lots.setdefault(key, Offered(lot, agent))
    left_out.update(dict.fromkeys(sorted(lots.keys() - left_out.keys())[MOST_LOTS:], TOO_MANY))
    lots = dict(sorted(lots.items()))
    left_out.update(dict.fromkeys(_waiting_for_themselves(lots), "it waits for itself"))
    while True:
        for key in left_out:
            lots.pop(key, None)
        names, gone = {name_of(it) for it in lots}, {name_of(it) for it in left_out}
        for key, offered in lots.items():
            if missing := set(offered.lot.together) - names:
                left_out[key] = f"it needs {min(missing)} at the same time, which nobody puts up"
            elif late := gone.intersection(offered.lot.after) - names:
                left_out[key] = f"it comes after {min(late)}, which is left out"
        if not lots.keys() & left_out.keys():
            break
    timed = any(it.lot.takes_s or it.lot.after or it.lot.ends_by_s is not None for it in lots.values())
    return Market(lots, dict(rows), left_out, _mates(lots), _before(lots), timed)


def _by_name(lots: Iterable[str]) -> dict[str, list[str]]:
    """Return the lots of each name: tasks that were born on different agents may have the same."""
    found: dict[str, list[str]] = {}
    for key in lots:
        found.setdefault(name_of(key), []).append(key)
    return found


def _mates(lots: Mapping[str, Offered]) -> dict[str, tuple[str, ...]]:
    named = _by_name(lots)
    found: dict[str, set[str]] = {key: set() for key in lots}
    for key, offered in lots.items():
        for mate in (it for name in offered.lot.together for it in named.get(name, ())):
            if mate != key:
                found[key].add(mate)
                found[mate].add(key)
    return {key: tuple(sorted(mates)) for key, mates in found.items()}


def _before(lots: Mapping[str, Offered]) -> dict[str, tuple[str, ...]]:
    named = _by_name(lots)
    return {key: tuple(it for name in offered.lot.after for it in named.get(name, ())) for key, offered in lots.items()}


def _waiting_for_themselves(lots: Mapping[str, Offered]) -> list[str]:
    """Return the lots that cannot come in any order: each of them waits for another one."""
    waits = {key: set(before) for key, before in _before(lots).items()}
    while free := [key for key, for_ in waits.items() if not for_]:
        for key in free:
            del waits[key]
        for for_ in waits.values():
            for_.difference_update(free)
    return list(waits)


def in_time(lot: Lot, end_s: float | None) -> bool:
    """Return whether a lot that is over at `end_s` (None: never) is over in time."""
    return end_s is not None and (lot.ends_by_s is None or end_s <= lot.ends_by_s + 1e-9)


def timetable(market: Market, bundles: Mapping[str, Collection[str]]) -> dict[str, float]:
    """Return when each allocated lot is over, in seconds from the beginning of the round.

    Each agent works at one lot after the other: of those that can begin, at the one that has to be over first. A lot
    that takes no time runs beside others. One that waits for a lot that nobody has is missing.
    """
    lots, before = market.lots, market.before
    agents = {key: agent for agent, keys in bundles.items() for key in keys if key in lots}
    ends = {key: 0.0 for key in agents if not (lots[key].lot.takes_s or before[key])}
    free_s = dict.fromkeys(bundles, 0.0)
    waits = {key: len({it for it in before[key] if it not in ends}) for key in agents if key not in ends}
    then: dict[str, list[str]] = {}
    for key in waits:
        for it in {it for it in before[key] if it not in ends}:
            then.setdefault(it, []).append(key)
    # What can begin, the next one first. If its agent is not free by then, it waits in a queue of that agent, of which
    # only the first is here: else each lot would be looked at again whenever its agent has finished another one.
    queues: dict[str, list[tuple[float, str]]] = {agent: [] for agent in bundles}
    queued: set[str] = set()
    ready = [(0.0, _due_s(lots[key].lot), key) for key, count in waits.items() if not count]
    heapify(ready)
    while ready:
        begin_s, due_s, key = heappop(ready)
        lot, agent = lots[key].lot, agents[key]
        if key in ends:
            continue
        queue = queues[agent]
        if lot.takes_s and begin_s < free_s[agent]:
            if key not in queued:
                queued.add(key)
                heappush(queue, (due_s, key))
                if queue[0] == (due_s, key):
                    heappush(ready, (free_s[agent], due_s, key))
            continue
        ends[key] = begin_s + lot.takes_s
        if lot.takes_s:
            free_s[agent] = ends[key]
            if key in queued:
                heappop(queue)
            if queue:
                heappush(ready, (free_s[agent], *queue[0]))
        for it in then.get(key, ()):
            waits[it] -= 1
            if not waits[it]:
                ready_s = max(ends[other] for other in before[it])
                heappush(ready, (ready_s, _due_s(lots[it].lot), it))
    return ends


def _due_s(lot: Lot) -> float:
    return math.inf if lot.ends_by_s is None else lot.ends_by_s


# The account of a round -------------------------------------------------------------------------------------------


class LotLine(msgspec.Struct, frozen=True):
    """What became of one lot.

    Attributes:
        task: the task, as `birthplace/name`.
        owner: the agent that has it.
        winner: the agent that is to have it; empty: nobody claims it, so it stays.
        bids: the bid of each agent for it, if it were the first of its bundle.
        refusals: why each other agent cannot take it.
        bid: the bid that won; None: none did.
        over_s: when it is over by the plan, in seconds from the beginning; None: there is no plan of time.
        reason: why nobody has won it; empty: an agent has.
    """

    task: str
    owner: str
    winner: str
    bids: dict[str, float]
    refusals: dict[str, str]
    bid: float | None = None
    over_s: float | None = None
    reason: str = ""


@packet_type("allocation.report")
class AllocationReport(msgspec.Struct, frozen=True):
    """The account of a round, as one agent knows it.

    Attributes:
        number: the number of the round.
        starter: the agent that began it.
        dry_run: whether nothing is moved.
        lines: one for each lot, by task.
        value: what the allocation is worth: the sum of the bids that won.
        present: what it would be worth if all tasks stayed where they are.
        optimum: what the best allocation is worth; None: it is not known, as without the extra `allocation`.
        agreed: whether all agents that took part had each other's newest rows.
        ignored: why rows of agents did not count, by agent.
        silent: the linked agents that took no part.
        duration_s: host time from the beginning to the end.
    """

    number: int
    starter: str
    dry_run: bool
    lines: tuple[LotLine, ...]
    value: float
    present: float
    optimum: float | None = None
    agreed: bool = True
    ignored: dict[str, str] = msgspec.field(default_factory=dict)
    silent: tuple[str, ...] = ()
    duration_s: float = 0.0

    @property
    def gap(self) -> float | None:
        """How far the value is from the optimum, as a share of it; None: that is not known."""
        if self.optimum is None:
            return None
        return (self.optimum - self.value) / self.optimum if self.optimum > 0 else 0.0

    @property
    def moves(self) -> tuple[LotLine, ...]:
        """The lots that are to have another owner."""
        return tuple(it for it in self.lines if it.winner not in ("", it.owner))
