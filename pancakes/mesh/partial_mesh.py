"""Choose which links to keep if an agent does not link to every other one (the setting `links`). Pure.

The agent knows all agents of its fleet by gossip: where each can be dialled, and when it was last heard of. It keeps
a few links to agents drawn at random, and makes others while there is something to send. Old entries are not passed
on, so all agents forget one that has died.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

MOST_KNOWN: Final = 4096
"""At most this many agents are known, ..."""
MOST_OF_PEER: Final = 1024
"""... and this many that only one peer has named, and that never had a link."""
FRESH_S: Final = 120.0
"""An agent that was not heard of for this time is not named to peers, and is dialled only if needed."""
FORGOTTEN_S: Final = 600.0
"""It is forgotten after this time."""
LOOK_S: Final = 3.0
"""How often the number of links is checked."""
SOON_S: Final = 0.2
"""If links are missing and no further agent was known, links are checked this soon after an agent was heard of: peers
name many at once, and the links are drawn from all of them."""
LATE_S: Final = 2.0
"""A link that takes longer to be made counts as missing at the next check: the agent may be dead, so another one is
drawn too."""
MADE_S: Final = 10.0
"""How long a link may take to be made; packets for the agent wait that long."""
AVOIDED_S: Final = 60.0
"""An agent to which no link could be made is dialled only if needed for this time."""
MANY: Final = 2
"""Links end if there are this many times more than should be kept. If fewer ended, the other agent would have too few,
and make one to a third, which would then have too many."""
REST_S: Final = 30.0
"""Surplus links end if they carried no packet for this time."""
WALK_S: Final = 300.0
"""How often a link to a further agent is made, so that two halves of a parted fleet meet again."""

Sighting = tuple[str, tuple[str, ...], float]
"""An agent to name to others: its name, its addresses, and how long ago it was connected."""


class MakeLink(msgspec.Struct, frozen=True):
    """Dial an agent at these addresses, until a link to it is up or `DropWaiting` comes."""

    name: str
    listen: tuple[str, ...]


class EndLink(msgspec.Struct, frozen=True):
    """End the link to an agent: it is surplus and not used."""

    name: str


class DropWaiting(msgspec.Struct, frozen=True):
    """Drop what waits for an agent: no link to it was made."""

    name: str
    listen: tuple[str, ...]


FewDecision = MakeLink | EndLink | DropWaiting


class LinkUse(msgspec.Struct, frozen=True):
    """How a link is used.

    Attributes:
        may_end: whether this agent may end it: it dialled it, and not because the configuration names the address.
        quiet_s: for how long it carried no packet.
    """

    may_end: bool
    quiet_s: float


class _HeardOf(msgspec.Struct):
    listen: tuple[str, ...]
    heard_s: float
    by: str = ""  # the peer that named it first; empty: it is or was linked


class FewLinks:
    """Decide which links to make and to end.

    Args:
        most: how many links to agents it keeps, if there are that many agents.
        source: random numbers, which choose the agents, so that the links of all agents connect the whole fleet.
        now_s: host time.
    """

    def __init__(self, most: int, source: random.Random, now_s: float) -> None:
        self._most = most
        self._random = source
        self._known: dict[str, _HeardOf] = {}
        self._wanted: dict[str, float] = {}  # the agents to which links are being made, and until when
        self._avoided: dict[str, float] = {}  # the agents that are not dialled unasked, and until when
        self._told_by: Counter[str] = Counter()  # how many of the known agents each peer has named
        self._to_tell: list[str] = []
        self._forgets_s = now_s + FORGOTTEN_S / 10
        self._walks_s = now_s + source.uniform(0.0, WALK_S)
        self._lacks = True  # links are missing, and no agent is left to link to
        self.due_s = now_s

    def describe(self) -> dict[str, int]:
        """Return how many links it keeps and how many agents it knows. Any thread."""
        return {"links": self._most, "known": len(self._known)}

    def on_sighting(self, name: str, listen: Sequence[str], age_s: float, now_s: float, by: str = "") -> None:
        """Note that an agent was heard of.

        Args:
            name: the agent.
            listen: the addresses at which it can be dialled here.
            age_s: how long ago it was connected; 0: it is linked to this agent, or named itself.
            now_s: host time.
            by: the peer that named it; empty: it is linked to this agent.
        """
        known, heard_s = self._known.get(name), now_s - age_s
        if known is not None and known.heard_s >= heard_s:
            return
        room = len(self._known) < MOST_KNOWN and self._told_by[by] < MOST_OF_PEER
        if listen and age_s < FRESH_S and (known is not None or room):
            first = by if known is None or not by else known.by
            self._known[name] = _HeardOf(tuple(listen), heard_s, first)
            self._count(known, self._known[name])
            if self._lacks and known is None:
                self.due_s = min(self.due_s, now_s + SOON_S)

    def knows(self, name: str) -> bool:
        """Return whether it knows where an agent can be dialled. Any thread."""
        return name in self._known

    def wants(self, name: str) -> bool:
        """Return whether a link to an agent is being made."""
        return name in self._wanted

    def fresh(self, now_s: float) -> list[Sighting]:
        """Return all agents to name to others, by name."""
        ages = ((name, it.listen, max(0.0, now_s - it.heard_s)) for name, it in sorted(self._known.items()))
        return [row for row in ages if row[2] < FRESH_S]

    def some(self, count: int, now_s: float) -> list[Sighting]:
        """Return the next agents to name to others, at most `count`; all take turns."""
        if not self._to_tell:
            self._to_tell = list(self._known)
        names, self._to_tell = self._to_tell[-count:], self._to_tell[:-count]
        found = [(name, self._known[name]) for name in names if name in self._known]
        return [(name, it.listen, now_s - it.heard_s) for name, it in found if now_s - it.heard_s < FRESH_S]

    def seek(self, name: str, now_s: float) -> list[FewDecision]:
        """Note that there is something to send to an agent; return the decision to link to it, if any."""
        if name not in self._known:  # it has just been forgotten
            return [DropWaiting(name, ())]
        return [self._make(name, now_s)] if name not in self._wanted else []

    def on_link_up(self, name: str) -> None:
        """Note that a link to an agent is up. If it ends soon, another one is made when needed."""
        self._wanted.pop(name, None)

    def tick(self, now_s: float, linked: Mapping[str, LinkUse]) -> list[FewDecision]:
        """Check all links; return what to make and to end.

        Args:
            now_s: host time.
            linked: how each link to an agent is used, by name.
        """
        self.due_s = now_s + LOOK_S
        if now_s >= self._forgets_s:
            self._forgets_s = now_s + FORGOTTEN_S / 10
            self._known = {name: it for name, it in self._known.items() if now_s - it.heard_s < FORGOTTEN_S}
            self._told_by = Counter(it.by for it in self._known.values() if it.by)
        self._avoided = {name: until_s for name, until_s in self._avoided.items() if until_s > now_s}
        decisions: list[FewDecision] = []
        for name, until_s in list(self._wanted.items()):
            if name in linked:
                del self._wanted[name]
            elif now_s >= until_s:
                del self._wanted[name]
                self._avoided[name] = now_s + AVOIDED_S
                known = self._known.get(name)
                decisions.append(DropWaiting(name, known.listen if known is not None else ()))
        soon = sum(until_s - now_s > MADE_S - LATE_S for until_s in self._wanted.values())
        missing = self._most - len(linked) - soon
        if now_s >= self._walks_s:
            self._walks_s = now_s + WALK_S
            missing = max(missing, 1)
        self._lacks = False
        if missing > 0:
            others = [name for name, _, _ in self.fresh(now_s) if not self._is_taken(name, linked)]
            drawn = self._random.sample(others, min(missing, len(others)))
            self._lacks = len(drawn) < missing
            decisions.extend(self._make(name, now_s) for name in drawn)
        unused = [(use.quiet_s, name) for name, use in linked.items() if use.may_end and use.quiet_s >= REST_S]
        surplus = len(linked) - MANY * self._most
        if surplus > 0:
            decisions.extend(EndLink(name) for _, name in sorted(unused, reverse=True)[:surplus])
        return decisions

    def _count(self, before: _HeardOf | None, after: _HeardOf) -> None:
        if before is not None and before.by:
            self._told_by[before.by] -= 1
        if after.by:
            self._told_by[after.by] += 1

    def _is_taken(self, name: str, linked: Mapping[str, LinkUse]) -> bool:
        return name in linked or name in self._wanted or name in self._avoided

    def _make(self, name: str, now_s: float) -> MakeLink:
        self._wanted[name] = now_s + MADE_S
        return MakeLink(name, self._known[name].listen)
