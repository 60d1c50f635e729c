"""A terminal's place in one fleet: a client of its mesh, which asks agents by control packets and gets replies."""

from __future__ import annotations

import random
import uuid
from collections.abc import Callable, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from pancakes.control import Reply
from pancakes.errors import LocalProtocolError, PancakesError
from pancakes.mesh.net.mesh import Mesh
from pancakes.mesh.net.transport import Transport
from pancakes.mesh.wire.link_messages import Hello, Identity
from pancakes.packet import SYSCTRL, Packet, body_class, type_name, type_of
from pancakes.runtime.clock import Clock

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys

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
