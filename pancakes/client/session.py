"""The connections below a client: find running agents, say hello, send requests and collect their replies.

- `Session` is what a program has. It finds agents and holds one `FleetSession` for each fleet. It starts from
  addresses, or from the runtime directory of this machine. Each agent that answers names its peers, so it learns the
  whole fleet.
- `FleetSession` is a member of one fleet's mesh with the role `client`: it listens at no address, is no agent's
  neighbour, and is never asked to take a task.
- `HelloProbe` asks which agent is at an address. An agent identifies itself only to members of its fleet.
- `MergedSubscriptions` merges the subscriptions of one program, because an agent keeps one per client and channel.

Callbacks run in the transport's thread and must not block. All other methods may be called from any thread, except that
threads of an agent must not wait here.
"""

from __future__ import annotations

import os
import random
import secrets
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pancakes.control import Describe, Follow, Reply, Unfollow
from pancakes.errors import ControlRefusedError, LocalProtocolError, PancakesError, UnreachableError
from pancakes.mesh.address import DEFAULT_FLEET, MDNS, dialled, fleet_in, in_fleet, is_local, reachable_from
from pancakes.mesh.codec import frame
from pancakes.mesh.link import Link, LinkTimes, Over, SendMessage
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.messages import Hello, Identity
from pancakes.mesh.peers import reachable
from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport, Transport
from pancakes.packet import SYSCTRL, Packet, body_class, type_name, type_of
from pancakes.security.key_store import fleets_of_person, keys_of_person
from pancakes.util.clock import Clock, MonotonicClock
from pancakes.util.plugins import Plugins
from pancakes.util.runtime_dir import entries, why_none
from pancakes.util.text import fault_of_name, hint_of

if TYPE_CHECKING:
    from pancakes.mesh.announcements import Announcement
    from pancakes.security.keys import Keys


ANNOUNCE_S: Final = 1.5
"""How long a client waits for announcements after its start, in seconds of the host. It asks within 0.12 s and again
after a second, and answers come within 0.12 s (RFC 6762)."""
MOST_ANNOUNCED: Final = 64
"""A client dials no announced address if it knows this many agents: they know the others."""
LOOK_S: Final = 0.1
"""How often a wait checks facts that come without an event, such as an agent that says it sleeps."""
CLOSED: Final = "the client is closed: make a new one"


@dataclass(frozen=True, slots=True)
class Target:
    """Where to look for agents.

    Attributes:
        addresses: addresses to begin with (`tcp://127.0.0.1:7401`), or `mdns:` for the agents that announce themselves
            on the networks of this machine; none: what runs on this machine.
        fleet: only agents of this fleet; empty: of any.
    """

    addresses: tuple[str, ...] = ()
    fleet: str = ""

    @classmethod
    def of(cls, at: Target | str | Sequence[str], fleet: str = "") -> Target:
        """Return the place that one address, several addresses or a `Target` mean.

        Args:
            at: the addresses.
            fleet: the fleet, if `at` names none.

        Raises:
            PancakesError: an address is not one that an agent could have, the name of the fleet is not valid, or two
                fleets are named.
        """
        addresses = at.addresses if isinstance(at, Target) else (at,) if isinstance(at, str) else at
        named = at.fleet if isinstance(at, Target) else ""
        if fleet and named not in ("", fleet):
            raise PancakesError(f"a client keeps to one fleet, and was given {named!r} and {fleet!r}")
        if (named or fleet) and (fault := fault_of_name(named or fleet)):
            raise PancakesError(fault)
        return cls(_addresses(addresses), named or fleet)


def _addresses(texts: Sequence[str]) -> tuple[str, ...]:
    try:
        return tuple(dict.fromkeys(text if text == MDNS else dialled(text) for text in texts))
    except ValueError as error:
        raise PancakesError(str(error)) from None


@dataclass
class Replies:
    """What several agents replied to the same request.

    Attributes:
        replies: the name of each agent that answered, and its reply, by fleet and name.
        silent: a sentence for each agent that did not.
        asleep: those of these sentences whose agent had announced that its network would sleep.
    """

    replies: list[tuple[str, Reply]]
    silent: list[str]
    asleep: list[str] = field(default_factory=list)


@dataclass
class FleetDescription:
    """What the agents report about themselves.

    Attributes:
        agents: the result of `Describe` of each that answered, by fleet and name.
        silent: see `Replies`.
        asleep: see `Replies`.
    """

    agents: list[dict[str, Any]] = field(default_factory=list)
    silent: list[str] = field(default_factory=list)
    asleep: list[str] = field(default_factory=list)


class News:
    """Let any thread wait until a condition is true, which is checked whenever there is news.

    Args:
        clock: the host clock.
        lock: held while a condition is checked.
    """

    def __init__(self, clock: Clock, lock: threading.RLock) -> None:
        self._clock = clock
        self._lock = lock
        self._closed = False
        # One lock for each waiting thread, held while there is no news. Not a `Condition`: its `wait` is written in
        # Python, and Ctrl-C in the middle of it leaves the lock in a broken state, so a program that then shuts down
        # would wait for ever.
        self._no_news: list[threading.Lock] = []

    def notify(self) -> None:
        """Wake all threads that wait."""
        for no_news in tuple(self._no_news):
            with suppress(RuntimeError):  # it was notified already
                no_news.release()

    def close(self) -> None:
        """End all waits with an error, including those that begin later."""
        self._closed = True
        self.notify()

    def wait(self, until_s: float, condition: Callable[[], bool]) -> bool:
        """Wait until the condition is true, or until a host time; return whether it is true.

        Raises:
            PancakesError: the client is closed, or is closed meanwhile.
        """
        no_news = threading.Lock()
        no_news.acquire()
        self._no_news.append(no_news)
        try:
            while True:
                if self._closed:
                    raise PancakesError(CLOSED)
                # Not `with`: from Python 3.14 on Ctrl-C may come between its taking of the lock and its block.
                try:
                    self._lock.acquire()
                    if condition():
                        return True
                finally:
                    try:
                        self._lock.release()
                    except RuntimeError:
                        pass  # Ctrl-C came before it was taken
                left_s = until_s - self._clock.now()
                if left_s <= 0:
                    return False
                no_news.acquire(timeout=min(left_s, LOOK_S))
        finally:
            self._no_news.remove(no_news)


class FleetAccess(NamedTuple):
    """What a client needs to reach the agents of a fleet.

    Attributes:
        name: the client's name in that fleet.
        transport: moves the bytes.
        keys: the keys of this person; None: without keys.
    """

    name: str
    transport: SocketTransport
    keys: Keys | None = None

    @classmethod
    def to(cls, fleet: str, clock: Clock) -> FleetAccess:
        """Make the access to a fleet: with this person's keys if there are any, else in the clear.

        Raises:
            PancakesError: the keys cannot be used; the message says why.
        """
        folder = keys_of_person(fleet)
        if folder is None:
            name = f"cli-{os.getpid()}-{secrets.token_hex(3)}"
            return cls(name, SocketTransport(clock, name, Plugins(), insecure=True))
        from pancakes.security.keys import Keys  # it imports OpenSSL, which is slow

        keys = Keys(folder)
        if fault := keys.fault_of(keys.own):
            raise PancakesError(f"your keys for the fleet {fleet} cannot be used ({folder}): {fault}")
        name = f"{keys.own.name}.{secrets.token_hex(4)}"
        return cls(name, SocketTransport(clock, name, Plugins(), keys=keys), keys)


OnHello = Callable[[Hello | str], None]
"""Takes the agent's hello, or the reason why there is none. In the transport's thread, once."""


class HelloProbe(ConnectionHandler):
    """Connect to an address, exchange hellos with the agent there, and disconnect.

    Args:
        transport: moves the bytes.
        address: where to connect.
        name: the client name to say hello with.
        fleet: the fleet in which the agent is expected.
        clock: the host clock.
        on_hello: see `OnHello`.
    """

    def __init__(
        self, transport: Transport, address: str, name: str, fleet: str, clock: Clock, on_hello: OnHello
    ) -> None:
        self._on_hello: OnHello | None = on_hello
        self._now = clock.now
        own = Identity(name, str(uuid.uuid4()), fleet=fleet, role="client").hello()
        self._link = Link(own, LinkTimes(), clock.now())
        self._connection: Connection | None = None
        transport.dial(address, self)

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        self._connection = connection
        for action in self._link.open(self._now()):
            if isinstance(action, SendMessage):
                connection.send(frame([action.message]))

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""
        actions = self._link.receive(data, self._now())
        if self._link.peer is not None:
            self._report(self._link.peer)
        elif actions and isinstance(actions[-1], Over):
            self._report(actions[-1].reason)

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""
        self._report(reason)

    def _report(self, result: Hello | str) -> None:
        on_hello, self._on_hello = self._on_hello, None
        if on_hello is None:
            return
        on_hello(result)
        if self._connection is not None:
            self._connection.close()


Answer = Reply | str
"""The outcome of a request: the agent's reply, or the reason why there will be none."""

Listener = Callable[[str, Packet], None]
"""Takes (agent, packet) of what an agent sent that answers none of our requests. In the transport's thread."""

Unreadable = Callable[[str, Packet, str], None]
"""Takes (agent, packet without its body, reason) if a packet cannot be read here. In the transport's thread."""


class FleetSession:
    """Be a client in the mesh of one fleet.

    Args:
        name: the client's name; unique, as an agent's is.
        fleet: the fleet.
        transport: moves the bytes.
        clock: the host clock.
        on_change: called in the transport's thread after an agent came, went or answered.
        keys: the keys of this person; None: without keys.
    """

    def __init__(
        self,
        name: str,
        fleet: str,
        transport: Transport,
        clock: Clock,
        on_change: Callable[[], None],
        keys: Keys | None = None,
    ) -> None:
        self.name = name
        self.fleet = fleet
        self._on_change = on_change
        self._numbers = count(1)
        self._asked: dict[int, str] = {}
        self._answers: dict[int, Answer] = {}
        self._listeners: list[tuple[Listener, Unreadable]] = []
        self._links: dict[str, int] = {}
        self._mesh = Mesh(
            Identity(name, str(uuid.uuid4()), 0, fleet, "client"),
            transport,
            "",
            (),
            random.Random(),
            clock,
            on_packets=self._on_packets,
            on_unfit=self._on_unfit,
            on_peer_up=self._on_peer_up,
            on_peer_down=self._on_peer_down,
            keys=keys,
        )
        self._mesh.start()

    def learn(self, address: str) -> None:
        """Connect to the agent at an address; its own peers follow."""
        self._mesh.learn((address,))

    def redial(self, addresses: Sequence[str]) -> None:
        """Dial agents that are not connected at once, instead of when the next attempt is due."""
        self._mesh.learn(tuple(addresses))
        self._mesh.redial()

    def listen(self, listener: Listener, unreadable: Unreadable = lambda agent, packet, reason: None) -> None:
        """Pass on what agents send besides replies, such as the packets of subscriptions."""
        self._listeners.append((listener, unreadable))

    def unlisten(self, listener: Listener) -> None:
        """Stop passing packets on to a listener."""
        self._listeners = [it for it in self._listeners if it[0] != listener]

    def agents(self) -> list[Hello]:
        """Return the hellos of the connected agents, by name; other clients do not count."""
        return [hello for hello in self._mesh.connected().values() if hello.role != "client"]

    def is_connected(self, agent: str) -> bool:
        """Return whether an agent can be asked."""
        return any(hello.name == agent for hello in self.agents())

    def address_of(self, agent: str) -> str:
        """Return the address at which a connected agent was dialled; empty if it is no longer connected."""
        return next((link["remote"] for link in self._mesh.links() if link["name"] == agent), "")

    def link(self, agent: str) -> int:
        """Return the number of the current link to an agent; 0: no link.

        An agent forgets its subscribers when their link ends, so each link has a number of its own.
        """
        return self._links.get(agent, 0) if self.is_connected(agent) else 0

    def asleep(self) -> dict[str, float | None]:
        """Return the agents that announced that they sleep, and for how many more seconds (None: not announced)."""
        return {peer["name"]: peer["for_s"] for peer in self._mesh.describe()["asleep"]}

    def refused(self) -> dict[str, str]:
        """Return the addresses whose agents refuse this client, such as one that is full, each with its reason."""
        return {it["address"]: it["refused"] for it in self._mesh.describe()["addresses"] if it["refused"]}

    def request(self, agent: str, body: Any) -> int:
        """Send a control packet to a connected agent, without waiting.

        Returns:
            The number of the request, for `answer`.

        Raises:
            LocalProtocolError: the body cannot travel, so the agent was not asked.
        """
        number = next(self._numbers)
        packet = Packet(SYSCTRL, type_name(body), self.name, agent, 0.0, number, body)
        self._asked[number] = agent
        try:
            self._mesh.send(packet)
        except LocalProtocolError:
            self.forget(number)
            raise
        except PancakesError as error:
            self._settle(number, str(error))
        return number

    def answer(self, number: int) -> Answer | None:
        """Return the outcome of a request; None while it is not known."""
        return self._answers.get(number)

    def forget(self, number: int) -> None:
        """Drop a request and its outcome, even one that comes later."""
        self._asked.pop(number, None)
        self._answers.pop(number, None)

    def publish(self, agent: str, channel: str, body: Any, stamp: float, destination: str = "") -> None:
        """Publish a packet on a channel of a connected agent.

        Args:
            agent: the agent.
            channel: its channel.
            body: the packet's body.
            stamp: the agent's mission time.
            destination: an address on the agent; empty: all subscribers there.

        Raises:
            PancakesError: it cannot be encoded, or the agent is no longer connected.
        """
        number = next(self._numbers)
        self.send(Packet(channel, type_of(body), self.name, destination or agent, stamp, number, body))

    def send(self, packet: Packet) -> None:
        """Send a packet unchanged to the connected agent that its destination names; errors are those of `publish`."""
        self._mesh.send(packet)

    def waiting(self, agent: str) -> int:
        """Return how many packets wait here because an agent, or the link to it, is too slow for them."""
        return sum(sum(peer["waiting"].values()) for peer in self._mesh.describe()["peers"] if peer["name"] == agent)

    def close(self) -> None:
        """Leave the mesh. The caller, which made the transport, closes it."""
        self._mesh.stop()

    def _settle(self, number: int, answer: Answer) -> None:
        if self._asked.pop(number, None) is not None:
            self._answers[number] = answer

    def _answered(self, peer: str, number: int, answer: Answer) -> None:
        """Take an answer, if it comes from the agent that was asked."""
        if self._asked.get(number) == peer:
            self._settle(number, answer)

    def _on_packets(self, peer: str, packets: Sequence[Packet], size: int) -> None:
        for packet in packets:
            if isinstance(packet.body, Reply) and packet.cause is not None and packet.cause[0] == self.name:
                self._answered(peer, packet.cause[1], packet.body)
            else:
                for listener, _ in self._listeners:
                    listener(peer, packet)
        self._on_change()

    def _on_unfit(self, peer: str, packet: Packet, reason: str) -> None:
        if body_class(packet.type) is Reply and packet.cause is not None and packet.cause[0] == self.name:
            self._answered(peer, packet.cause[1], f"its answer cannot be read: {reason}")
        else:
            for _, unreadable in self._listeners:
                unreadable(peer, packet, reason)
        self._on_change()

    def _on_peer_up(self, hello: Hello) -> None:
        self._links[hello.name] = self._links.get(hello.name, 0) + 1
        self._on_change()

    def _on_peer_down(self, name: str, reason: str, asleep_s: float | None) -> None:
        for number, agent in list(self._asked.items()):
            if agent == name:
                self._settle(number, f"the link to it ended before it answered: {reason}")
        self._on_change()


class MergedSubscriptions:
    """Merge what the subscribers of a program ask of each channel, because an agent keeps one request per client."""

    def __init__(self) -> None:
        # Held while a request is made and sent, so that the last one that is sent covers all subscribers.
        self._lock = threading.Lock()
        self._requests: dict[tuple[str, str, str], dict[object, Follow]] = {}  # by fleet, agent and channel

    def add(self, subscriber: object, session: FleetSession, agent: str, request: Follow) -> int:
        """Ask an agent for what a subscriber and all others want.

        Returns:
            The number of the request, for `FleetSession.answer`.
        """
        with self._lock:
            requests = self._requests.setdefault((session.fleet, agent, request.channel), {})
            requests[subscriber] = request
            return session.request(agent, merged(requests.values()))

    def remove(self, subscriber: object, session: FleetSession, agent: str, channel: str) -> None:
        """Unsubscribe one subscriber at an agent, without waiting."""
        with self._lock:
            requests = self._requests.get((session.fleet, agent, channel), {})
            if requests.pop(subscriber, None) is None:
                return
            if requests:
                number = session.request(agent, merged(requests.values()))
            else:
                del self._requests[session.fleet, agent, channel]
                number = session.request(agent, Unfollow(channel))
            session.forget(number)


def merged(requests: Iterable[Follow]) -> Follow:
    """Return the request that brings what each of several requests for one channel brings. Pure."""
    several = list(requests)
    types = (
        () if any(not it.types for it in several) else tuple(dict.fromkeys(name for it in several for name in it.types))
    )
    most_hz = 0.0 if any(not it.most_hz for it in several) else max(it.most_hz for it in several)
    return Follow(several[0].channel, types, any(it.include_remote for it in several), most_hz)


@dataclass
class Candidate:
    """An agent that may be reachable.

    Attributes:
        address: where; empty if it cannot be dialled.
        fleet: its fleet; empty while that is not known.
        name: its name; empty while that is not known.
        failed: why it cannot be asked; empty while it can.
        local: whether the runtime directory of this machine names it.
    """

    address: str
    fleet: str = ""
    name: str = ""
    failed: str = ""
    local: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.address})" if self.name and self.address else self.name or self.address

    def no_answer(self, why: str) -> str:
        """Return the sentence that it did not answer, and why; `why` is empty if that is not known."""
        if why.startswith(f"{self.address} "):  # it names the address itself
            return f"{self}{why.removeprefix(self.address)}"
        return f"{self} did not answer" + (f": {why}" if why else "")


class Announced:
    """The agents that announce themselves by mDNS on the networks of this machine.

    Raises:
        PancakesError: `zeroconf` is not installed, or the network does not let it.
    """

    def __init__(self) -> None:
        from pancakes.mesh.dns_sd import DnsServiceDiscovery, check_installed, own_interfaces  # slow, and rarely used

        check_installed("no agent is found by mDNS")
        self._clock = MonotonicClock()
        try:
            own = own_interfaces()
            self._discovery = DnsServiceDiscovery(own) if own else None
        except OSError as error:
            raise PancakesError(f"no agent is found by mDNS: {error.strerror or error}") from None
        self._until_s = self._clock.now() + (ANNOUNCE_S if own else 0.0)

    def found(self) -> list[Announcement]:
        """Return what is announced now."""
        return self._discovery.found() if self._discovery is not None else []

    def may_find_more(self) -> bool:
        """Return whether agents that run now may still be missing."""
        return self._clock.now() < self._until_s

    def close(self) -> None:
        """End."""
        if self._discovery is not None:
            self._discovery.close()


AgentKey = tuple[str, str]
"""The fleet and the name of an agent."""


class Session:
    """Find agents, stay connected to them, and ask one, several or all of them.

    `pancakes.client.Client` is built on it, and so is the web page, which watches a whole fleet from one thread.

    Args:
        at: an address to begin with (`HOST`, `HOST:PORT` or `local://NAME`, or `mdns:` for the agents that announce
            themselves), or several; none: what runs on this machine. A `Target` names a fleet as well.
        timeout_s: the time limit of each call.

    Attributes:
        timeout_s: the same.
        subscriptions: what is subscribed to, on which channels of which agents.

    Raises:
        PancakesError: an address is not valid, or the runtime directory cannot be used.
    """

    def __init__(self, at: Target | str | Sequence[str] = (), timeout_s: float = 3.0) -> None:
        where = Target.of(at)
        self.timeout_s = timeout_s
        self.subscriptions = MergedSubscriptions()
        self._clock = MonotonicClock()
        self._lock = threading.RLock()
        self._news = News(self._clock, self._lock)
        self._accesses: dict[str, FleetAccess] = {}
        self._fleets: dict[str, FleetSession] = {}
        self._probes = count(1)
        self._candidates: list[Candidate] = []
        self._at = where.addresses
        self._fleet = where.fleet
        self._announced = Announced() if MDNS in self._at else None
        fleet = self._fleet or DEFAULT_FLEET
        named = [Candidate(in_fleet(address, fleet)) for address in self._at if address != MDNS]
        try:
            for it in named if self._at else self._running():
                self._probe(it)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave all fleets; a thread that still waits gets an error."""
        self._news.close()
        if self._announced is not None:
            self._announced.close()
        for fleet in self.fleets():
            fleet.close()
        for access in self._accesses.values():
            access.transport.close()

    # Time ------------------------------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the host time, in seconds."""
        return self._clock.now()

    def until_s(self, timeout_s: float | None) -> float:
        """Return the host time at which a time limit ends; None: the session's limit."""
        return self._clock.now() + (self.timeout_s if timeout_s is None else timeout_s)

    def too_late(self, timeout_s: float | None) -> str:
        """Return the reason for a missing answer: the time limit is over; None: the session's limit."""
        return f"nothing came within {self.timeout_s if timeout_s is None else timeout_s:g} s"

    def wait(self, until_s: float, condition: Callable[[], bool]) -> bool:
        """Wait until the condition is true, or until a host time; return whether it is true.

        It is checked whenever an agent comes, goes, answers or sends something, and every `LOOK_S`.

        Raises:
            PancakesError: the client is closed, or is closed meanwhile.
        """
        return self._news.wait(until_s, condition)

    # Which agents are there ------------------------------------------------------------------------------------

    def is_own(self, name: str) -> bool:
        """Return whether a name in the mesh is that of this session, in one of its fleets."""
        return any(access.name == name for access in self._accesses.values())

    def is_connected(self, agent: str, fleet: str = "") -> bool:
        """Return whether an agent can be asked now, in this fleet or (empty) in any."""
        with self._lock:
            return any(it.is_connected(agent) for it in self._fleets.values() if fleet in ("", it.fleet))

    def fleets(self) -> list[FleetSession]:
        """Return the sessions in the fleets that are known by now."""
        with self._lock:
            return list(self._fleets.values())

    def fleet_of(self, agent: str) -> FleetSession:
        """Return the session in the fleet of a connected agent.

        Raises:
            UnreachableError: it is not connected now.
            ControlRefusedError: agents of two fleets have this name.
        """
        found = [it for it in self.fleets() if it.is_connected(agent)]
        _require_one(agent, [it.fleet for it in found])
        if not found:
            raise UnreachableError(f"{agent} is not connected")
        return found[0]

    def use_fleet(self, fleet: str) -> None:
        """Speak only to the agents of one fleet from now on."""
        with self._lock:
            self._fleet = fleet
            self._candidates = [it for it in self._candidates if it.fleet in ("", fleet)]
            left = [it for it in self._fleets.values() if it.fleet != fleet]
            self._fleets = {name: it for name, it in self._fleets.items() if name == fleet}
        for it in left:
            it.close()

    def refresh(self) -> None:
        """Find agents of this machine that were started since, and dial those that are away.

        Only a session that was given no address looks at this machine. It stops looking for agents of this machine that
        have ended since.

        Raises:
            PancakesError: the runtime directory cannot be used.
        """
        running = [] if self._at else self._running()
        with self._lock:
            self._probe_announced()
            known = {(it.fleet, it.name, it.address) for it in self._candidates}
            new = [it for it in running if (it.fleet, it.name, it.address) not in known]
            moved = {(it.fleet, it.name) for it in new}
            there = {(it.fleet, it.name) for it in running}
            self._candidates = [
                it
                for it in self._candidates
                if (it.fleet, it.name) not in moved
                and (not it.local or (it.fleet, it.name) in there or self.is_connected(it.name, it.fleet))
            ]
            for it in new:
                self._probe(it)
            for fleet in self._fleets.values():
                ours = [it for it in self._candidates if it.fleet == fleet.fleet and it.address]
                if away := [it.address for it in ours if not fleet.is_connected(it.name)]:
                    fleet.redial(away)

    def probe_again(self) -> None:
        """Ask again which agents are at the addresses at which none was found."""
        with self._lock:
            for it in [it for it in self._candidates if it.failed and it.address and not it.name]:
                self._candidates.remove(it)
                self._probe(Candidate(it.address))

    # Asking them -----------------------------------------------------------------------------------------------

    def find(self, agent: str, until_s: float) -> FleetSession:
        """Wait until an agent is connected, and return the session in its fleet.

        Raises:
            UnreachableError: there is no such agent.
            ControlRefusedError: agents of two fleets have this name.
        """

        def connected() -> list[FleetSession]:
            return [it for it in self._fleets.values() if it.is_connected(agent)]

        def is_found() -> bool:
            return self._is_found(agent, {it.fleet for it in connected()})

        with self._lock:
            known = is_found()
        answers, silent = ({}, []) if known else self._ask(until_s, lambda answers: is_found())
        with self._lock:
            found = connected()
        _require_one(agent, [it.fleet for it in found])
        if found:
            return found[0]
        why = next((why or "it did not answer in time" for it, why in silent if it.name == agent), "")
        if why:
            raise UnreachableError(f"{agent} cannot be reached: {why}")
        raise UnreachableError(self._unknown(agent, sorted({name for _, name in answers}), silent))

    def search(self, enough: Callable[[], bool]) -> None:
        """Ask all agents that can be found which others they know, until `enough` is true or all have answered."""
        self._ask(self.until_s(None), lambda answers: enough())

    def describe(self, *agents: str, timeout_s: float | None = None) -> FleetDescription:
        """Ask all agents, or those named, to describe themselves; arguments and errors are those of `request_all`."""
        found = self.request_all(None, *agents, timeout_s=timeout_s)
        return FleetDescription([reply.result for _, reply in found.replies], found.silent, found.asleep)

    def request_all(self, body: Any, *agents: str, timeout_s: float | None = None) -> Replies:
        """Ask all agents, or those named, the same at once, including those that other agents know.

        Args:
            body: a control packet's body that changes nothing, such as `Channels()`; None: `Describe()`.
            agents: only these; empty strings do not count.
            timeout_s: the time limit; None: that of the session.

        Raises:
            UnreachableError: no agent answers in time, or no agent has one of the names.
            ControlRefusedError: agents of two fleets have the same name.
        """
        wanted = [name for name in dict.fromkeys(agents) if name]

        def enough(answers: dict[AgentKey, Reply]) -> bool:
            return bool(wanted) and all(
                self._is_found(name, {it[0] for it in answers if it[1] == name}) for name in wanted
            )

        answers, silent = self._ask(self.until_s(timeout_s), enough, body, wanted)
        with self._lock:
            if wanted:
                for name in wanted:
                    _require_one(name, [fleet for fleet, other in answers if other == name])
                    if all(it[1] != name for it in answers) and all(it.name != name for it, _ in silent):
                        raise UnreachableError(self._unknown(name, sorted({other for _, other in answers}), silent))
                answers = {key: reply for key, reply in answers.items() if key[1] in wanted}
                silent = [(it, why) for it, why in silent if it.name in wanted]
            sleeping = {(fleet.fleet, name) for fleet in self._fleets.values() for name in fleet.asleep()}
            sentences = [it.no_answer(why or self.too_late(timeout_s)) for it, why in silent]
            if not answers:
                raise UnreachableError(
                    "\n".join(sentences) or f"{self._no_agents()}: start one, or name one with --at",
                )
            asleep = [text for text, (it, _) in zip(sentences, silent, strict=True) if (it.fleet, it.name) in sleeping]
            return Replies([(key[1], answers[key]) for key in sorted(answers)], sentences, asleep)

    def _ask(
        self,
        until_s: float,
        enough: Callable[[dict[AgentKey, Reply]], bool],
        body: Any = None,
        wanted: Sequence[str] = (),
    ) -> tuple[dict[AgentKey, Reply], list[tuple[Candidate, str]]]:
        """Ask all agents that can be found to describe themselves.

        Args:
            until_s: when to give up.
            enough: returns whether the answers so far are enough.
            body: another request; its reply is then the answer.
            wanted: only these agents are asked for that; none: all.

        Returns:
            The answers, and the agents that have given none, each with the reason if it is known.
        """
        asked: dict[AgentKey, tuple[FleetSession, int]] = {}
        described: set[AgentKey] = set()
        answers: dict[AgentKey, Reply] = {}
        failed: dict[AgentKey, str] = {}

        def silent() -> Iterator[tuple[Candidate, str]]:
            for it in self._candidates:
                key = (it.fleet, it.name)
                if key not in answers:
                    yield it, it.failed or failed.get(key, "")

        def take(key: AgentKey, fleet: FleetSession, reply: Reply) -> None:
            if key in described:
                answers[key] = reply
                return
            described.add(key)
            self._learn_peers(fleet, reply.result)
            if body is not None and (not wanted or key[1] in wanted):
                fleet.forget(asked[key][1])
                asked[key] = fleet, fleet.request(key[1], body)
            else:
                answers[key] = reply

        def done() -> bool:
            may_come = self._probe_announced()
            for fleet in list(self._fleets.values()):
                for hello in fleet.agents():
                    key = (fleet.fleet, hello.name)
                    if key not in asked:
                        asked[key] = fleet, fleet.request(hello.name, Describe())
                for name, for_s in fleet.asleep().items():
                    failed[fleet.fleet, name] = "its network sleeps" + ("" if for_s is None else f" for {for_s:.1f} s")
                for address, why in fleet.refused().items():
                    for it in self._candidates:
                        if (it.fleet, it.address) == (fleet.fleet, address) and not fleet.is_connected(it.name):
                            failed[fleet.fleet, it.name] = why
            for key, (fleet, number) in list(asked.items()):
                answer = fleet.answer(number)
                if isinstance(answer, str):
                    failed[key] = answer
                elif answer is not None and not answer.ok and key not in described:
                    failed[key] = answer.reason
                elif answer is not None and key not in answers:
                    take(key, fleet, answer)
            return enough(answers) or (not may_come and all(why for _, why in silent()))

        self.wait(until_s, done)
        with self._lock:
            for fleet, number in asked.values():
                fleet.forget(number)
            return answers, list(silent())

    def _is_found(self, agent: str, fleets: set[str]) -> bool:
        """Return whether an agent has been found, given the fleets in which its name was found.

        Waits for all candidates of that name, so that two agents with one name are noticed.
        """
        named = {it.fleet for it in self._candidates if it.name == agent and not it.failed}
        return bool(fleets) and named <= fleets

    def _unknown(self, agent: str, names: list[str], silent: Sequence[tuple[Candidate, str]]) -> str:
        """Return the sentences that say that an agent was not found; `names`: the agents that answered."""
        lines = [it.no_answer(why) for it, why in silent]
        there = f"there is no agent {agent!r}{hint_of(agent, names)}"
        if not names:
            there = f"no agent knows of an agent {agent!r}" if lines else self._no_agents()
        if silent and not any(it.name for it, _ in silent) and not names:
            return "\n".join(lines)  # no agent was reached that could know of it
        return "\n".join([*lines, there])

    def _no_agents(self) -> str:
        """Return a sentence that says that no agent runs, and where."""
        if not self._at:
            return why_none(self._fleet)
        of = f" of the fleet {self._fleet}" if self._fleet else ""
        if self._at == (MDNS,):
            return f"no agent{of} announces itself by mDNS on the networks of this machine"
        return f"no agent{of} runs at {', '.join(self._at)}"

    # Finding them ----------------------------------------------------------------------------------------------

    def _running(self) -> list[Candidate]:
        """Return the agents of this machine, as candidates."""
        there = [entry for entry in entries() if entry.role != "client" and self._fleet in ("", entry.fleet)]
        return [Candidate(next(iter(entry.listen), ""), entry.fleet, entry.name, local=True) for entry in there]

    def _probe_announced(self) -> bool:
        """Dial the agents that were announced since; return whether more may come soon.

        An announcement proves nothing. So only agents of a fleet of which this person has keys are dialled: without
        keys, a program that announces itself could pass for any agent.
        """
        if self._announced is None:
            return False
        known = {(it.fleet, it.name, it.address) for it in self._candidates}
        for it in self._announced.found():
            if self._fleet not in ("", it.fleet) or len(known) >= MOST_ANNOUNCED:
                continue
            failed = "" if keys_of_person(it.fleet) is not None else f"you have no keys of the fleet {it.fleet}"
            for address in it.addresses[:1] if failed else it.addresses:
                if (it.fleet, it.name, address) in known:
                    continue
                known.add((it.fleet, it.name, address))
                candidate = Candidate(address, it.fleet, it.name, failed)
                if failed:
                    self._candidates.append(candidate)
                else:
                    self._probe(candidate)
        return self._announced.may_find_more()

    def _probe(self, candidate: Candidate) -> None:
        """Find out which agent is at a candidate's address, and connect to it in its fleet."""
        self._candidates.append(candidate)
        if not candidate.address:
            candidate.failed = candidate.failed or "it listens at no address, so it cannot be asked from here"
            return

        def on_hello(result: Hello | str) -> None:
            with self._lock:
                self._on_hello(candidate, result)
            self._news.notify()

        fleet = self._expected_fleet(candidate)
        access = self._access(fleet)
        name = f"{access.name}.{next(self._probes)}"
        HelloProbe(access.transport, candidate.address, name, fleet, self._clock, on_hello)

    def _access(self, fleet: str) -> FleetAccess:
        made = self._accesses.get(fleet)
        if made is None:
            made = self._accesses[fleet] = FleetAccess.to(fleet, self._clock)
        return made

    def _expected_fleet(self, candidate: Candidate) -> str:
        """Return the fleet to say hello in: an agent identifies itself only to members of its own."""
        if found := candidate.fleet or self._fleet or fleet_in(candidate.address):
            return found
        with suppress(PancakesError):  # an agent elsewhere can be asked without the runtime directory
            if here := [entry.fleet for entry in entries() if candidate.address in entry.listen]:
                return here[0]
        own = fleets_of_person()
        if len(own) > 1 and DEFAULT_FLEET not in own and not is_local(candidate.address):
            raise PancakesError(f"you have keys of {len(own)} fleets: choose one with --fleet ({', '.join(own)})")
        return own[0] if len(own) == 1 else DEFAULT_FLEET

    def _on_hello(self, candidate: Candidate, result: Hello | str) -> None:
        if isinstance(result, str):
            fleet = self._expected_fleet(candidate)
            keyless = not is_local(candidate.address) and self._access(fleet).keys is None
            keyless = keyless and not result.startswith(f"{candidate.address} ")  # nothing there could ask for them
            candidate.failed = f"{result} (you have no keys of the fleet {fleet} )" if keyless else result
        elif candidate.name and (candidate.name, candidate.fleet) != (result.name, result.fleet):
            candidate.failed = f"at its address there is {result.name} of the fleet {result.fleet}"
        elif self._fleet not in ("", result.fleet):
            candidate.failed = f"it is {result.name} of the fleet {result.fleet}, not of {self._fleet}"
        else:
            candidate.name, candidate.fleet = result.name, result.fleet
            joined = self._fleets.get(result.fleet)
            if joined is None:
                access = self._access(result.fleet)
                joined = self._fleets[result.fleet] = FleetSession(
                    access.name, result.fleet, access.transport, self._clock, self._news.notify, access.keys
                )
            joined.learn(candidate.address)
        # A missing candidate is dialled again and again once another agent of its fleet is connected.
        for other in self._candidates:
            if other.failed and (later := self._fleets.get(fleet_in(other.address))) is not None:
                later.learn(other.address)

    def _learn_peers(self, fleet: FleetSession, description: dict[str, Any]) -> None:
        """Make candidates of the agents that a described agent is connected to."""
        remote = fleet.address_of(description["agent"])
        if not remote:
            return
        access = self._access(fleet.fleet)
        keyless = access.keys is None and not description["insecure"]
        for peer in description["mesh"]["peers"]:
            name = peer["name"]
            if peer["role"] == "client" or any((it.fleet, it.name) == (fleet.fleet, name) for it in self._candidates):
                continue
            there = [reachable(it, remote) for it in reachable_from(remote, peer["addresses"], access.transport.reach)]
            failed = ""
            if keyless and not all(is_local(it) for it in there):
                there = [it for it in there if is_local(it)] or _local_addresses(fleet.fleet, name)
                failed = f"you have no keys of the fleet {fleet.fleet}, which agents ask for over tcp://"
            unmet = next((it for it in self._candidates if not it.name and it.address in there), None)
            if unmet is not None and not unmet.failed:
                unmet.fleet, unmet.name = fleet.fleet, name
            else:
                if unmet is not None:  # no agent had answered there yet
                    self._candidates.remove(unmet)
                self._probe(Candidate(next(iter(there), ""), fleet.fleet, name, failed))


def _require_one(agent: str, fleets: Sequence[str]) -> None:
    if len(fleets) > 1:
        several = " and ".join(sorted(fleets))
        raise ControlRefusedError(f"the fleets {several} both have an agent {agent}: name one of them with --fleet")


def _local_addresses(fleet: str, name: str) -> list[str]:
    """Return the `local://` addresses of an agent; none if it does not run on this machine."""
    with suppress(PancakesError):
        there = [next(iter(it.listen), "") for it in entries() if (it.fleet, it.name) == (fleet, name)]
        return [address for address in there if is_local(address)]
    return []
