"""A client's session in the mesh of one fleet: who it is there, the links to agents, requests and their replies.

- `Waits`: lets any thread wait for what the transport's thread learns.
- `FleetWay`: the name, the keys and the transport that a client uses in a fleet.
- `Greeting`: asks which agent is at an address. An agent identifies itself only to members of its fleet.
- `Door`: the session. It is a member of the mesh with the role `client`: it listens at no address, is no agent's
  neighbour, and is never asked to take a task.
- `Wishes`: merges the subscriptions of one program, because an agent keeps one per client and channel.

Callbacks run in the transport's thread and must not block. All other methods may be called from any thread.
"""

from __future__ import annotations

import os
import random
import secrets
import threading
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from itertools import count
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pancakes.control import Follow, Reply, Unfollow
from pancakes.errors import LocalProtocolError, PancakesError
from pancakes.mesh.codec import frame
from pancakes.mesh.link import Link, LinkTimes, Over, SendMessage
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.messages import Hello, Identity
from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport, Transport
from pancakes.packet import SYSCTRL, Packet, body_class, type_name, type_of
from pancakes.security.key_store import keys_of_person
from pancakes.util.clock import Clock
from pancakes.util.plugins import Plugins

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


LOOK_S: Final = 0.1
"""How often a wait looks again at facts that come without an event, such as an agent that says it sleeps."""
CLOSED: Final = "the client is closed: make a new one"


class Waits:
    """Lets any thread wait until a condition is true, which is looked at whenever there is news.

    Args:
        clock: the host clock.
        lock: held while a condition is looked at.
    """

    def __init__(self, clock: Clock, lock: AbstractContextManager[object]) -> None:
        self._clock = clock
        self._lock = lock
        self._closed = False
        # One for each thread that waits, held while there is no news. No `Condition`: Ctrl-C in the middle of its
        # `wait`, which is written in Python, leaves its lock in disorder, and a program that then ends in good order
        # waits for ever.
        self._no_news: list[threading.Lock] = []

    def tell(self) -> None:
        """There is news."""
        for no_news in tuple(self._no_news):
            with suppress(RuntimeError):  # there is some already
                no_news.release()

    def close(self) -> None:
        """Ends all waits, those to come too, with an error."""
        self._closed = True
        self.tell()

    def until(self, until_s: float, condition: Callable[[], bool]) -> bool:
        """Waits until the condition is true, at most until a host time; returns whether it is.

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
                with self._lock:
                    if condition():
                        return True
                left_s = until_s - self._clock.now()
                if left_s <= 0:
                    return False
                no_news.acquire(timeout=min(left_s, LOOK_S))
        finally:
            self._no_news.remove(no_news)


class FleetWay(NamedTuple):
    """How the agents of a fleet are reached.

    Attributes:
        name: the name of the terminal in that fleet.
        transport: how bytes travel.
        keys: those of this person; None: there are none.
    """

    name: str
    transport: SocketTransport
    keys: Keys | None = None

    @classmethod
    def to(cls, fleet: str, clock: Clock) -> FleetWay:
        """Makes the way to a fleet: with the keys of this person, where there are any, else in the clear.

        Raises:
            PancakesError: the keys cannot be used; the sentence says why.
        """
        folder = keys_of_person(fleet)
        if folder is None:
            name = f"cli-{os.getpid()}-{secrets.token_hex(3)}"
            return cls(name, SocketTransport(clock, name, Plugins(), insecure=True))
        from pancakes.security.keys import Keys  # and with it OpenSSL, which takes its time

        keys = Keys(folder)
        if fault := keys.fault_of(keys.own):
            raise PancakesError(f"your keys for the fleet {fleet} are of no use ({folder}): {fault}")
        name = f"{keys.own.name}.{secrets.token_hex(4)}"
        return cls(name, SocketTransport(clock, name, Plugins(), keys=keys), keys)


Told = Callable[[Hello | str], None]
"""Takes what the agent said about itself, or the reason why nothing is known. In the transport's thread, once."""


class Greeting(ConnectionHandler):
    """Connects to an address, says hello, listens to the agent's hello, and goes.

    Args:
        transport: how bytes travel.
        address: where to.
        name: the name under which it says hello, as a client.
        fleet: the fleet of which the agent is to be.
        clock: the host clock.
        told: see `Told`.
    """

    def __init__(self, transport: Transport, address: str, name: str, fleet: str, clock: Clock, told: Told) -> None:
        self._told: Told | None = told
        self._now = clock.now
        own = Identity(name, str(uuid.uuid4()), fleet=fleet, role="client").hello()
        self._link = Link(own, LinkTimes(), clock.now())
        self._connection: Connection | None = None
        transport.dial(address, self)

    def opened(self, connection: Connection) -> None:
        """See `Handler`."""
        self._connection = connection
        for action in self._link.open(self._now()):
            if isinstance(action, SendMessage):
                connection.send(frame([action.message]))

    def received(self, data: bytes) -> None:
        """See `Handler`."""
        actions = self._link.receive(data, self._now())
        if self._link.peer is not None:
            self._tell(self._link.peer)
        elif actions and isinstance(actions[-1], Over):
            self._tell(actions[-1].reason)

    def closed(self, reason: str) -> None:
        """See `Handler`."""
        self._tell(reason)

    def _tell(self, what: Hello | str) -> None:
        told, self._told = self._told, None
        if told is None:
            return
        told(what)
        if self._connection is not None:
            self._connection.close()


Answer = Reply | str
"""What became of a request: the agent's reply, or the reason why there will be none."""

Listener = Callable[[str, Packet], None]
"""Takes (agent, packet) of what an agent sent that answers none of our requests. In the transport's thread."""


Unread = Callable[[str, Packet, str], None]
"""Takes (agent, packet without its body, reason) where a packet of an agent cannot be read here. Likewise."""


class Door:
    """One mesh of one fleet. It listens at no address, is no agent's neighbour, and is never asked to take a task.

    Args:
        name: the client's name; unique, as an agent's is.
        fleet: the fleet.
        transport: how bytes travel.
        clock: the host clock.
        changed: called in the transport's thread after an agent came or went, or answered.
        keys: those of this person; None: there are none.
    """

    def __init__(
        self,
        name: str,
        fleet: str,
        transport: Transport,
        clock: Clock,
        changed: Callable[[], None],
        keys: Keys | None = None,
    ) -> None:
        self.name = name
        self.fleet = fleet
        self._changed = changed
        self._numbers = count(1)
        self._asked: dict[int, str] = {}
        self._answers: dict[int, Answer] = {}
        self._listeners: list[tuple[Listener, Unread]] = []
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
        """Connects to the agent at an address; those that it is connected to follow."""
        self._mesh.learn((address,))

    def dial_again(self, addresses: Sequence[str]) -> None:
        """Dials at once the agents that are not connected, instead of when the next attempt is due."""
        self._mesh.learn(tuple(addresses))
        self._mesh.redial()

    def listen(self, listener: Listener, unread: Unread = lambda agent, packet, reason: None) -> None:
        """Hands on what agents send of themselves, such as what is followed."""
        self._listeners.append((listener, unread))

    def unlisten(self, listener: Listener) -> None:
        """Hands on nothing to a listener any more."""
        self._listeners = [it for it in self._listeners if it[0] != listener]

    def agents(self) -> list[Hello]:
        """Returns what the connected agents said about themselves, by name; other clients are none."""
        return [hello for hello in self._mesh.connected().values() if hello.role != "client"]

    def connected(self, agent: str) -> bool:
        """Returns whether an agent can be asked."""
        return any(hello.name == agent for hello in self.agents())

    def place_of(self, agent: str) -> str:
        """Returns the address at which a connected agent was dialled; empty where it is connected no more."""
        return next((link["remote"] for link in self._mesh.links() if link["name"] == agent), "")

    def link(self, agent: str) -> int:
        """Returns the number of the link to an agent that stands now, 0 where none does.

        An agent forgets its followers when their link ends, so each link has a number of its own.
        """
        return self._links.get(agent, 0) if self.connected(agent) else 0

    def asleep(self) -> dict[str, float | None]:
        """Returns the agents that said they sleep, and for how many more seconds (None: they did not say)."""
        return {peer["name"]: peer["for_s"] for peer in self._mesh.describe()["asleep"]}

    def refused(self) -> dict[str, str]:
        """Returns the addresses whose agents will not have us, such as one that is full, each with its reason."""
        return {it["address"]: it["refused"] for it in self._mesh.describe()["addresses"] if it["refused"]}

    def request(self, agent: str, body: Any) -> int:
        """Sends a control packet to a connected agent, and waits for nothing.

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
        """Returns what became of a request; None where that is not known yet."""
        return self._answers.get(number)

    def forget(self, number: int) -> None:
        """Drops a request: what became of it, or will."""
        self._asked.pop(number, None)
        self._answers.pop(number, None)

    def publish(self, agent: str, channel: str, body: Any, stamp: float, destination: str = "") -> None:
        """Publishes a packet on a channel of a connected agent.

        Args:
            agent: the agent.
            channel: its channel.
            body: the packet's body.
            stamp: the agent's mission time.
            destination: an address on the agent; empty: all subscribers there.

        Raises:
            PancakesError: it cannot travel, or the agent is not connected any more.
        """
        number = next(self._numbers)
        self.send(Packet(channel, type_of(body), self.name, destination or agent, stamp, number, body))

    def send(self, packet: Packet) -> None:
        """Sends a packet as it is to the connected agent that its destination names.

        Raises:
            PancakesError: as `publish`.
        """
        self._mesh.send(packet)

    def waiting(self, agent: str) -> int:
        """Returns how many packets wait here because an agent, or the way to it, is too slow for them."""
        return sum(sum(peer["waiting"].values()) for peer in self._mesh.describe()["peers"] if peer["name"] == agent)

    def close(self) -> None:
        """Leaves the mesh. The caller closes the transport, which it has made."""
        self._mesh.stop()

    def _settle(self, number: int, answer: Answer) -> None:
        if self._asked.pop(number, None) is not None:
            self._answers[number] = answer

    def _answered(self, peer: str, number: int, answer: Answer) -> None:
        """Takes an answer, where it comes from the agent that was asked."""
        if self._asked.get(number) == peer:
            self._settle(number, answer)

    def _on_packets(self, peer: str, packets: Sequence[Packet], size: int) -> None:
        for packet in packets:
            if isinstance(packet.body, Reply) and packet.cause is not None and packet.cause[0] == self.name:
                self._answered(peer, packet.cause[1], packet.body)
            else:
                for listener, _ in self._listeners:
                    listener(peer, packet)
        self._changed()

    def _on_unfit(self, peer: str, packet: Packet, reason: str) -> None:
        if body_class(packet.type) is Reply and packet.cause is not None and packet.cause[0] == self.name:
            self._answered(peer, packet.cause[1], f"its answer cannot be read: {reason}")
        else:
            for _, unread in self._listeners:
                unread(peer, packet, reason)
        self._changed()

    def _on_peer_up(self, hello: Hello) -> None:
        self._links[hello.name] = self._links.get(hello.name, 0) + 1
        self._changed()

    def _on_peer_down(self, name: str, reason: str, asleep_s: float | None) -> None:
        for number, agent in list(self._asked.items()):
            if agent == name:
                self._settle(number, f"the link to it ended before it answered: {reason}")
        self._changed()


Place = tuple[str, str, str]
"""Fleet, agent and channel."""


class Wishes:
    """An agent knows one wish of a program for each channel, so theirs are put together. Any thread."""

    def __init__(self) -> None:
        # Held while a request is made and sent, so that the last one that is sent has all wishes.
        self._lock = threading.Lock()
        self._wishes: dict[Place, dict[object, Follow]] = {}

    def ask(self, follower: object, door: Door, agent: str, wish: Follow) -> int:
        """Asks an agent for what a follower wishes to hear, and for what the others do.

        Returns:
            The number of the request, for `Door.answer`.
        """
        with self._lock:
            wishes = self._wishes.setdefault((door.fleet, agent, wish.channel), {})
            wishes[follower] = wish
            return door.request(agent, together(wishes.values()))

    def drop(self, follower: object, door: Door, agent: str, channel: str) -> None:
        """Tells an agent that a follower wishes to hear nothing any more; waits for nothing."""
        with self._lock:
            wishes = self._wishes.get((door.fleet, agent, channel), {})
            if wishes.pop(follower, None) is None:
                return
            if wishes:
                number = door.request(agent, together(wishes.values()))
            else:
                del self._wishes[door.fleet, agent, channel]
                number = door.request(agent, Unfollow(channel))
            door.forget(number)


def together(wishes: Iterable[Follow]) -> Follow:
    """Returns the wish that brings what each of several wishes for one channel brings. Pure."""
    several = list(wishes)
    types = (
        () if any(not it.types for it in several) else tuple(dict.fromkeys(name for it in several for name in it.types))
    )
    most_hz = 0.0 if any(not it.most_hz for it in several) else max(it.most_hz for it in several)
    return Follow(several[0].channel, types, any(it.foreign for it in several), most_hz)
