"""Membership: which agents exist, which connection to each stays, and when to dial an address again. Pure.

Every method takes an event and the host time, and returns decisions (`Dial`, `Admit`, `TurnDown`, ...), which `Mesh`
carries out. All known addresses are dialled side by side until their agents are connected. Agents tell each other the
addresses of their peers, so a fleet becomes a full mesh, or a partial one (`pancakes.mesh.partial_mesh`).
`AddressBook` keeps the addresses and their back-off.

Of two agents, the one with the lower name chooses the connection that stays (see `pancakes.mesh.link`): it prefers
its own dial to the other's, and an established connection to a new one, unless it has died.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, ItemsView, Sequence
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.mesh.address import ReachOf, is_local, nameable_from, parse_address, reach_of, spelt
from pancakes.mesh.admission import THIS_MACHINE, ClientPlace, client_to_end, machine_of
from pancakes.mesh.link import LinkTimes
from pancakes.mesh.messages import AgentSeen, Goodbye, Hello, Refusal, fault_of_address
from pancakes.mesh.partial_mesh import DropWaiting, EndLink, FewDecision, FewLinks, LinkUse, MakeLink, Sighting


class Dial(msgspec.Struct, frozen=True):
    """Open a connection to `address`, and call it `link`."""

    address: str
    link: int


class Admit(msgspec.Struct, frozen=True):
    """Tell the peer that `link` is the one that stays."""

    link: int


class TurnDown(msgspec.Struct, frozen=True):
    """Refuse `link`, or end it if it is up: the peer gets the code and the reason."""

    link: int
    code: Refusal
    reason: str


class Rest(msgspec.Struct, frozen=True):
    """End `link`, which is up. The agent is not gone: it is dialled again when there is something to send."""

    link: int


Decision = Dial | Admit | TurnDown | Rest | DropWaiting


MAX_LEARNT: Final = 512
"""Most addresses kept that were learnt from others."""
MOST_OF_PEER: Final = 16
"""Most addresses that one peer has named and at which no agent is connected."""
FORGET_AFTER: Final = 20
"""A learnt address is forgotten after this many failures in a row; the longest wait comes at the eighth."""

RESTS_S: Final = 600.0
"""A static address whose agent has ended a surplus link is dialled again after this time."""


class KnownAddress(msgspec.Struct):
    """An address that can be dialled."""

    static: bool
    due_s: float
    name: str = ""  # of the agent that was last met there
    link: int | None = None  # of the dial that is in progress, until a peer says hello there or it fails
    failures: int = 0
    ours: bool = False  # whether it is this agent's own
    refused: str = ""  # why the agent there refuses us, in its words
    rests: bool = False  # whether the link to its agent has ended as surplus
    by: str = ""  # the peer that named it; empty: the configuration or a person


class AddressBook:
    """The addresses that an agent knows.

    Args:
        own: the addresses at which it listens itself, which are not dialled.
        static: addresses that are always dialled.
        source: random numbers, which spread the retries.
        times: the times of membership.
        now_s: host time.
        is_up: returns whether the agent of a name is connected.
        may_be_named: returns whether a peer may name an address.
    """

    def __init__(
        self,
        own: Sequence[str],
        static: Sequence[str],
        source: random.Random,
        times: LinkTimes,
        now_s: float,
        is_up: Callable[[str], bool],
        may_be_named: Callable[[str], bool],
    ) -> None:
        self._own = own
        self._random = source
        self._times = times
        self._is_up = is_up
        self._may_be_named = may_be_named
        self._known = {address: KnownAddress(True, now_s) for address in static if address not in own}
        self._learnt = 0  # the number of learnt addresses

    def __contains__(self, address: str) -> bool:
        """Whether an address is known."""
        return address in self._known

    def __getitem__(self, address: str) -> KnownAddress:
        """What is known of an address."""
        return self._known[address]

    def get(self, address: str) -> KnownAddress | None:
        """Return what is known of an address; None: nothing."""
        return self._known.get(address)

    def items(self) -> ItemsView[str, KnownAddress]:
        """Return all addresses, and what is known of each."""
        return self._known.items()

    def describe(self) -> list[dict[str, Any]]:
        """Return each address with what is known of it, as plain values. Any thread."""
        return [
            {
                "address": address,
                "static": it.static,
                "name": it.name,
                "failures": it.failures,
                "refused": it.refused,
                "rests": it.rests,
            }
            for address, it in list(self._known.items())
            if not it.ours
        ]

    def are_awaited(self) -> bool:
        """Return whether a static address has no agent yet, and no dial to it has failed. Any thread."""
        known = list(self._known.values())
        return any(it.static and not (it.ours or it.failures or it.refused or self._is_up(it.name)) for it in known)

    def learn(self, address: str, now_s: float, name: str = "", by: str = "") -> bool:
        """Add an address that a peer named; return whether it is new.

        Args:
            address: the address.
            now_s: host time.
            name: the agent that listens there, if the agent itself said so.
            by: the peer that named it; empty: a person.
        """
        it = self._known.get(address)
        is_new = it is None
        if it is None:
            if fault_of_address(address) or address in self._own or self._learnt >= MAX_LEARNT:
                return False
            if by and (not self._may_be_named(address) or self._unmet(by) >= MOST_OF_PEER):
                return False
            it = self._known[address] = KnownAddress(False, now_s, by=by)
            self._learnt += 1
        if not it.static:  # a static one has the name of the agent that was met there
            it.name = name or it.name
        return is_new

    def failed(self, address: str, now_s: float, hopeless: bool) -> None:
        """Note that a dial has failed.

        Args:
            address: what was dialled.
            now_s: host time.
            hopeless: whether the next one would probably fail as well.
        """
        it = self._known[address]
        it.failures += 1
        if not it.static and it.failures >= FORGET_AFTER and not self._is_up(it.name):
            del self._known[address]
            self._learnt -= 1
        elif hopeless:
            it.due_s = now_s + self._times.retry_longest_s
        else:
            self.retry(it, now_s)

    def forget(self, address: str) -> None:
        """Forget a learnt address, once it is not being dialled."""
        it = self._known.get(address)
        if it is None or it.static:
            return
        if it.link is not None:
            it.failures = FORGET_AFTER
        else:
            del self._known[address]
            self._learnt -= 1

    def rest(self, address: str, now_s: float) -> None:
        """Do not dial the agent there for a while; a learnt address is forgotten."""
        it = self._known[address]
        if it.static:
            it.failures, it.due_s, it.rests = 0, now_s + RESTS_S, True
        else:
            self.forget(address)

    def retry(self, it: KnownAddress, now_s: float) -> None:
        """Delay the next dial by a random time with a doubling bound: full jitter."""
        doublings = min(max(it.failures - 1, 0), 30)
        bound_s = min(self._times.retry_first_s * 2**doublings, self._times.retry_longest_s)
        it.due_s = now_s + self._random.uniform(0.0, bound_s)

    def make_due(self, address: str, now_s: float) -> None:
        """Make an address due now, if it is known."""
        if (it := self._known.get(address)) is not None:
            it.due_s = min(it.due_s, now_s)

    def all_due(self, now_s: float) -> None:
        """Make all addresses due now."""
        for it in self._known.values():
            it.failures, it.due_s = 0, now_s

    def is_wanted(self, it: KnownAddress) -> bool:
        """Return whether an address should be dialled when it is due."""
        return it.link is None and not self._is_up(it.name) and it.due_s != math.inf

    def _unmet(self, peer: str) -> int:
        """Return how many addresses that a peer named have no connected agent."""
        return sum(it.by == peer and not self._is_up(it.name) for it in self._known.values())


MAX_AGENTS: Final = 256
"""Largest mesh: agents and environments connected to one agent, itself counted."""
MAX_CLIENTS: Final = 64
"""Most clients connected to one agent; see `pancakes.mesh.admission` for the next one."""
QUIET_S: Final = 5.0
"""An agent with few links gives the place of a link that is unused for this time to a newcomer."""
MOST_DIALS: Final = 8
"""How many learnt addresses are dialled at a time."""


class _Candidate(msgspec.Struct):
    """A connection whose peer has said hello; it is up or waits."""

    link: int
    hello: Hello
    address: str  # the address that we dialled, or empty
    machine: str  # the machine of the peer
    is_news: bool  # whether no peer had named one of its addresses
    up_s: float | None = None
    until_s: float = math.inf  # when waiting for our own dial ends
    rests: bool = False  # we are ending it as surplus


class Peers:
    """What is known of other agents, and the decisions about connections to them.

    Args:
        own: our own hello.
        static: addresses that are always dialled.
        source: random numbers for the spread of retries.
        times: the times of membership.
        now_s: host time.
        quiet_s: takes a link and the host time, and returns for how long the link carried no packet; infinite for a
            client that never sent one.
        may_be_named: returns whether a peer may name an address.
        reach: returns from how far away an address can be dialled.
        few: decides which links to make; None: one to each agent.

    Attributes:
        book: the addresses that are known. Any thread may read it.
    """

    def __init__(
        self,
        own: Hello,
        static: Sequence[str],
        source: random.Random,
        times: LinkTimes,
        now_s: float,
        quiet_s: Callable[[int, float], float] = lambda link, now_s: 0.0,
        may_be_named: Callable[[str], bool] = lambda address: True,
        reach: ReachOf = reach_of,
        few: FewLinks | None = None,
    ) -> None:
        self._own = own
        self._reach = reach
        self._may_be_named = may_be_named
        self._few = few
        self._times = times
        self._quiet_s = quiet_s
        self._dials: dict[int, str] = {}  # the addresses that are being dialled
        self._met_at: dict[str, int] = {}  # the addresses of the candidates that we dialled
        self._candidates: dict[int, _Candidate] = {}
        self._up: dict[str, _Candidate] = {}
        static = tuple(map(spelt, static))
        self.book = AddressBook(own.listen, static, source, times, now_s, self._up.__contains__, may_be_named)
        self._asleep: dict[str, float] = {}
        self._last_link = 0
        self._self_dials = 0  # connections from this agent to itself, counted at the dialled end

    def new_link(self) -> int:
        """Return a number for an incoming connection."""
        self._last_link += 1
        return self._last_link

    def connected(self) -> list[Hello]:
        """Return what the connected peers said about themselves, by name."""
        return [self._up[name].hello for name in sorted(self._up)]

    def asleep(self, now_s: float) -> dict[str, float]:
        """Return the sleeping peers, and for how many more seconds each sleeps (infinity: it gave no time).

        Any thread may call it, and `describe` too.
        """
        return {name: until_s - now_s for name, until_s in sorted(self._asleep.items()) if until_s > now_s}

    def gossip(self) -> list[Sighting]:
        """Return the connected agents to name to others; never clients."""
        return [(it.hello.name, it.hello.listen, 0.0) for it in self._linked() if it.hello.listen]

    def _linked(self) -> list[_Candidate]:
        """Return the links to all peers except clients, by name."""
        return [it for _, it in sorted(self._up.items()) if it.hello.role != "client"]

    def _unused_s(self, it: _Candidate, now_s: float) -> float:
        """Return for how long a link carried no packet, at most since it came up."""
        return min(self._quiet_s(it.link, now_s), now_s - it.up_s if it.up_s is not None else 0.0)

    def knows(self, name: str) -> bool:
        """Return whether an agent can be dialled if it has no link. Any thread."""
        return self._few is not None and self._few.knows(name)

    def seek(self, name: str, now_s: float) -> list[Decision]:
        """Dial an agent for which something waits, if there is no link to it."""
        if self._few is None or name in self._up:
            return []
        return self._carry_out(self._few.seek(name, now_s), now_s)

    def _carry_out(self, decisions: Sequence[FewDecision], now_s: float) -> list[Decision]:
        done: list[Decision] = []
        for it in decisions:
            if isinstance(it, MakeLink):
                for address in it.listen:
                    self.book.learn(address, now_s, it.name)
                    self.book.make_due(address, now_s)
            elif isinstance(it, EndLink):
                self._up[it.name].rests = True
                done.append(Rest(self._up[it.name].link))
            else:
                for address in it.listen:
                    self.book.forget(address)
                done.append(it)
        return [*done, *self._dial(now_s)]

    def _look_at_few(self, few: FewLinks, now_s: float) -> list[Decision]:
        linked: dict[str, LinkUse] = {}
        for it in self._linked():
            known = self.book.get(it.address)
            may_end = known is not None and not known.static
            linked[it.hello.name] = LinkUse(may_end, self._unused_s(it, now_s))
            few.on_sighting(it.hello.name, it.hello.listen, 0.0, now_s)
        return self._carry_out(few.tick(now_s, linked), now_s)

    def due_s(self) -> float:
        """Return the host time at which `tick` has something to do."""
        few_s = self._few.due_s if self._few is not None else math.inf
        busy = self._learnt_dials() >= MOST_DIALS
        wanted = [it for address, it in self.book.items() if it.link is None and self._wanted(address, it)]
        dials = [it.due_s for it in wanted if not (busy and it.by)]
        if len(self._candidates) == len(self._up):  # as nearly always
            return min((*dials, few_s))
        waits = [candidate.until_s for candidate in self._candidates.values() if candidate.up_s is None]
        return min((*dials, *waits, few_s))

    def tick(self, now_s: float) -> list[Decision]:
        """Dial what is due, and admit connections that waited long enough for a dial of our own."""
        few = self._few
        decisions = self._look_at_few(few, now_s) if few is not None and now_s >= few.due_s else self._dial(now_s)
        for candidate in list(self._candidates.values()):
            if candidate.up_s is None and now_s >= candidate.until_s:
                candidate.until_s = math.inf
                decisions.extend(self._admit_if_free(candidate))
        return decisions

    def _dial(self, now_s: float) -> list[Decision]:
        decisions: list[Decision] = []
        free = MOST_DIALS - self._learnt_dials()
        for address, it in self.book.items():
            if self._wanted(address, it) and now_s >= it.due_s and not (it.by and free <= 0):
                free -= bool(it.by)
                it.link = self.new_link()
                self._dials[it.link] = address
                decisions.append(Dial(address, it.link))
        return decisions

    def on_hello(self, link: int, hello: Hello, remote: str, now_s: float) -> list[Decision]:
        """Take the hello of a peer.

        Args:
            link: the connection.
            hello: the hello.
            remote: address of the other end of the connection, to stand in for a wildcard in `hello.listen`.
            now_s: host time.
        """
        address = self._dials.pop(link, "")
        if address:
            self.book[address].link = None
            self.book[address].ours = False
        own, name = self._own, hello.name
        if name == own.name:
            return self._namesake(link, hello, address, now_s)
        if address:
            self.book[address].name = name
        listen = tuple(filter(None, (reachable(it, remote) for it in hello.listen)))
        machine = machine_of(remote)
        if machine != THIS_MACHINE:  # others find what listens here on all interfaces at the address that they see
            hello = replace(hello, listen=listen)
        named = nameable_from(remote, listen, self._reach) if hello.role != "client" else ()
        learnt = [self.book.learn(it, now_s, name, name) for it in named]
        self._asleep.pop(name, None)
        is_news = any(learnt) if self._few is None else not self._few.knows(name)
        candidate = self._candidates[link] = _Candidate(link, hello, address, machine, is_news)
        if address:
            self._met_at[address] = link
        decisions: list[Decision] = []
        known = self._up.get(name)
        room: list[Decision] = []
        if known is not None and known.hello.journal != hello.journal:
            decisions.append(TurnDown(link, "name", _taken(name)))
        elif known is not None and known.hello.boot > hello.boot:
            decisions.append(TurnDown(link, "old", f"a later boot of {name} is connected to {own.name}"))
        elif known is None and (full := self._full(hello)) and not (room := self._make_room(candidate, now_s)):
            decisions.append(TurnDown(link, "full", full))
        else:
            decisions.extend(room)
            if known is not None and known.hello.boot < hello.boot:
                decisions.append(TurnDown(known.link, "old", f"{name} was started again"))
            if own.name < name:
                if not address and self._dialling(hello.listen):
                    candidate.until_s = now_s + self._times.hold_s
                else:
                    decisions.extend(self._admit_if_free(candidate))
        self._freed(address, now_s)
        return decisions

    def on_bytes(self, link: int) -> list[Decision]:
        """Note bytes on a link that is up: newer connections to the same peer are not needed."""
        mine = self._candidates.get(link)
        if mine is None or mine.up_s is None or len(self._candidates) == len(self._up):
            return []
        return [
            TurnDown(other.link, "duplicate", f"{self._own.name} has another link to {other.hello.name}, which stays")
            for other in self._candidates.values()
            if other.hello.name == mine.hello.name and other.up_s is None and self._own.name < other.hello.name
        ]

    def on_link_up(self, link: int, now_s: float) -> list[Decision]:
        """Note that a link is up, or will be when the peer has our welcome. Older links to that peer end."""
        candidate = self._candidates[link]
        name = candidate.hello.name
        known = self._up.get(name)
        if known is not None and known.hello.journal != candidate.hello.journal:
            return [TurnDown(link, "name", _taken(name))]
        candidate.up_s = now_s
        candidate.until_s = math.inf
        self._up[name] = candidate
        if self._few is not None:
            self._few.on_link_up(name)
        known_address = self.book.get(candidate.address)
        if known_address is not None:
            known_address.refused, known_address.rests = "", False
        decisions: list[Decision] = []
        if known is not None:
            decisions.append(TurnDown(known.link, "duplicate", f"{name} chose another link"))
        if self._own.name < name:  # it is alive now, so what waited beside it is not needed
            decisions.extend(self.on_bytes(link))
        return decisions

    def on_link_over(
        self,
        link: int,
        now_s: float,
        refused: Refusal | None = None,
        goodbye: Goodbye | None = None,
        broken: bool = False,
        refusal: str = "",
    ) -> list[Decision]:
        """Note that a connection has ended, or was never opened.

        Args:
            link: the connection.
            now_s: host time.
            refused: why it was refused, by either side.
            goodbye: the peer's goodbye, if it left on purpose.
            broken: whether it broke the protocol.
            refusal: the peer's sentence, if the peer refused.
        """
        hopeless = refused in ("version", "fleet", "name", "full", "old") or broken
        candidate = self._candidates.pop(link, None)
        if candidate is None:
            address = self._dials.pop(link, "")
            if not address:
                return []
            self.book[address].link = None
            self.book[address].refused = refusal
            self.book.failed(address, now_s, hopeless)
            self._freed(address, now_s)
            return []
        self._met_at.pop(candidate.address, None)
        name = candidate.hello.name
        was_up = self._up.get(name) is candidate
        if was_up:
            del self._up[name]
        if goodbye is not None and name in self._up:
            goodbye = None  # another agent said it, under the name of a connected one
        if goodbye is not None and goodbye.why == "sleep":
            self._asleep.pop(name, None)
            self._asleep[name] = now_s + (math.inf if goodbye.for_s is None else goodbye.for_s)
            if len(self._asleep) > MAX_LEARNT:  # some never wake
                del self._asleep[next(iter(self._asleep))]
        rests = candidate.rests or (goodbye is not None and goodbye.why == "rest")
        for address, it in list(self.book.items()):
            if it.name != name or it.link is not None or (candidate.address != address and not was_up):
                continue
            if rests:
                self.book.rest(address, now_s)
                continue
            it.refused = refusal if hopeless else ""
            if goodbye is not None and goodbye.why == "sleep" and goodbye.for_s is not None:
                it.failures = 0
                it.due_s = self._asleep[name]
            elif goodbye is not None or hopeless:
                it.due_s = now_s + self._times.retry_longest_s
            elif candidate.up_s is not None and now_s - candidate.up_s >= self._times.gone_s:
                it.failures = 0
                self.book.retry(it, now_s)
            else:
                self.book.failed(address, now_s, False)
        if not was_up:
            return []
        heirs = [other for other in self._candidates.values() if other.hello.name == name and other.up_s is None]
        if heirs and self._own.name < name:
            return self._admit_if_free(heirs[-1])
        return []

    def on_gossip(self, agents: Sequence[AgentSeen], now_s: float, peer: str, remote: str) -> list[Decision]:
        """Take the gossip of a peer.

        Args:
            agents: the agents.
            now_s: host time.
            peer: the peer.
            remote: the address of that peer.
        """
        named: list[str] = []
        for seen in agents:
            there = reachable(seen.address, remote)
            # Beacons mostly name known agents, and come from each peer all the time.
            if self._few is None and there in self.book:
                continue
            if there and nameable_from(remote, (there,), self._reach) and seen.name != self._own.name:
                named.append(there)
                if self._few is not None and self._may_be_named(there):
                    self._few.on_sighting(seen.name, (there,), seen.age_s, now_s, peer)
        return self.on_addresses(named, now_s, peer) if self._few is None else []

    def on_addresses(self, addresses: Sequence[str], now_s: float, peer: str = "") -> list[Decision]:
        """Take addresses of agents.

        Args:
            addresses: the addresses.
            now_s: host time.
            peer: the peer that named them; empty: a person.
        """
        addresses = [spelt(address) for address in addresses]
        unknown = [address for address in addresses if address not in self.book]
        new = [address for address in unknown if self.book.learn(address, now_s, by=peer)]
        return self.tick(now_s) if new else []

    def is_news(self, link: int) -> bool:
        """Return whether no peer had named the address of this peer: then others may not know it either."""
        return self._candidates[link].is_news

    def redial(self, now_s: float) -> None:
        """Make all addresses due now, because this agent woke up."""
        self.book.all_due(now_s)

    def _wanted(self, address: str, it: KnownAddress) -> bool:
        # The peer at that address must still tell whether the link stays, or when to dial again.
        return self.book.is_wanted(it) and address not in self._met_at

    def _learnt_dials(self) -> int:
        """Return how many learnt addresses are being dialled."""
        return sum(bool(self.book[address].by) for address in self._dials.values())

    def _dialling(self, listen: Sequence[str]) -> bool:
        known = [it for it in map(self.book.get, listen) if it is not None]
        return any(it.link is not None for it in known)

    def _namesake(self, link: int, hello: Hello, address: str, now_s: float) -> list[Decision]:
        own, is_own = self._own, hello.journal == self._own.journal
        if not address:  # the dialled end
            self._self_dials += is_own
            return [self._self_dial(link) if is_own else TurnDown(link, "name", _taken(own.name))]
        self._freed(address, now_s)
        it = self.book[address]
        it.due_s = now_s + self._times.retry_longest_s
        if not is_own:  # the agent that dials is the newcomer, and is refused by the other end
            it.refused = _taken(own.name)
            return []
        if self._self_dials == 0:
            # None of our connections came in here, so a program there repeats what it is sent.
            it.refused = f"the program there repeats what {own.name} sends"
            return [TurnDown(link, "name", it.refused)]
        self._self_dials -= 1
        it.ours, it.refused = True, ""
        return [self._self_dial(link)]

    def _self_dial(self, link: int) -> TurnDown:
        return TurnDown(link, "self", f"{self._own.name} dialled itself")

    def _full(self, hello: Hello) -> str:
        """Return why there is no room for another peer; empty: there is room."""
        clients = sum(candidate.hello.role == "client" for candidate in self._up.values())
        if hello.role == "client":
            reason = f"{self._own.name} is full: it has {clients} clients, and all of them are in use"
            return reason if clients >= MAX_CLIENTS else ""
        agents = len(self._up) - clients + 1
        # A terminal may link to all agents of a fleet of hundreds.
        most = MAX_LEARNT if self._own.role == "client" else MAX_AGENTS
        return f"{self._own.name} is full: it is in a mesh of {agents} already" if agents >= most else ""

    def _make_room(self, newcomer: _Candidate, now_s: float) -> list[Decision]:
        """End the link of a client that gives its place to a new one, if any.

        If only a few links are kept, a new agent gets the place of the least used link to an agent: of an unused one,
            or of
        any link if there is something to send to the newcomer.
        """
        if newcomer.hello.role != "client":
            unused = max(self._linked(), key=lambda it: self._unused_s(it, now_s), default=None)
            if self._few is None or unused is None:
                return []
            if self._unused_s(unused, now_s) < QUIET_S and not self._few.wants(newcomer.hello.name):
                return []
            unused.rests = True
            return [Rest(unused.link)]
        places = [
            ClientPlace(it.link, it.machine, self._quiet_s(it.link, now_s))
            for it in self._up.values()
            if it.hello.role == "client"
        ]
        link = client_to_end(newcomer.machine, places)
        if link is None:
            return []
        reason = f"{self._own.name} is full: it has {len(places)} clients, and this one gave its place to another"
        return [TurnDown(link, "full", reason)]

    def _admit_if_free(self, candidate: _Candidate) -> list[Decision]:
        """Admit a connection, unless its peer has one: then it waits until that one is dead or shows life."""
        known = self._up.get(candidate.hello.name)
        if known is None or known.hello.boot < candidate.hello.boot:
            return [Admit(candidate.link)]
        if candidate.address:  # we dialled although we had a link
            reason = f"{self._own.name} has another link to {candidate.hello.name}, which stays"
            return [TurnDown(candidate.link, "duplicate", reason)]
        return []

    def _freed(self, address: str, now_s: float) -> None:
        """Note that our dial to `address` is decided: the next tick, due now, handles what waited for it."""
        for candidate in self._candidates.values():
            if address and candidate.until_s < math.inf and address in candidate.hello.listen:
                candidate.until_s = now_s


def is_namesake(link: int, decisions: Sequence[Decision]) -> bool:
    """Return whether a connection is refused for its peer's name: the peer then learns nothing of this agent."""
    return any(isinstance(it, TurnDown) and (it.link, it.code) == (link, "name") for it in decisions)


def reachable(listen: str, remote: str) -> str:
    """Return the address at which an agent can be dialled, in normal form; empty if there is none.

    For an agent that listens on all interfaces it is the address that we see. The same holds for link-local addresses:
    the name of the interface that leads there differs on each machine.

    Args:
        listen: where it listens.
        remote: the address of the peer that named it, which is the agent itself or on the same machine.
    """
    try:
        there = parse_address(listen)
    except ValueError:
        return ""
    if there.path or not (there.everywhere or there.link_local):
        return str(there)
    try:
        seen = parse_address(remote)
    except ValueError:
        return ""
    if there.everywhere:
        host = "127.0.0.1" if is_local(remote) else seen.host
    elif seen.loopback:
        host = there.host
    else:  # it is seen at another address, and the interface that leads there from here is not known
        host = seen.host if there.host.partition("%")[0] == seen.host.partition("%")[0] else ""
    return str(replace(there, host=host)) if host else ""


def _taken(name: str) -> str:
    return f"the name {name} is already taken by another agent: give one of the two another name"
