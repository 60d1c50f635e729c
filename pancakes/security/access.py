"""Decide what a peer may do at this agent: whose packets it may send, and which rights they need.

Each agent speaks only for itself; clients may also replay packets. A peer with a certificate has the rights that the
roster gives it, any other peer those of the agent's own file. Pure, except for the table of peers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from pancakes.control import CONTROLS, Reload, Reply
from pancakes.packet import CORE_CHANNELS, CTRL, NETWORK, SYSCTRL, SYSTEM, Packet, agent_of, type_name
from pancakes.security.roster import AccessRule, Bearer, Right, Roster, allows


def fault_of_source(own_role: str, peer: str, role: str, packet: Packet) -> str:
    """Return why a peer may not send packets from this source, as a sentence; empty: it may.

    Packets of an agent come only over the link to that agent. But on `system`, and on channels that are not core
    channels, a client may replay packets of others (`pancakes replay`), and receives the packets of others from its
    peer.

    Args:
        own_role: the role of this agent.
        peer: the name of the agent, or terminal, at the other end of the link.
        role: its role.
        packet: one of the packets, which have one source and one channel.
    """
    source, channel = packet.source, packet.channel
    if agent_of(source) == peer or ("client" in (own_role, role) and may_be_replayed(channel)):
        return ""
    return f"{peer} ({role}) sends packets of {source} on {channel!r}, but may speak only for itself"


def may_be_replayed(channel: str) -> bool:
    """Return whether a terminal may send packets of others on this channel."""
    return channel == SYSTEM or channel not in CORE_CHANNELS


_ASKING: Final = frozenset(map(type_name, CONTROLS))
_CONTROL_TYPES: Final = _ASKING | {type_name(Reply)}
_MOST_KNOWN: Final = 4096
_AMONG_ITSELF: Final = ("migration.", "guard.", "halt.", "post.", "task.")
"""Types of packets whose right is checked where they are read, or that answer a request: the state machines know which
agents they asked."""


def right_of(body: object) -> Right:
    """Return the right that a control packet needs."""
    tries = getattr(body, "dry_run", False) and not isinstance(body, Reload)  # also a try of that runs what it imports
    return "look" if tries else CONTROLS[type(body)]


def asks(packet: Packet) -> bool:
    """Return whether a packet asks an agent for something."""
    return packet.channel == SYSCTRL and packet.type in _ASKING


def needs(packet: Packet) -> tuple[Right, tuple[str, ...]] | None:
    """Return the right that a packet of a peer needs to enter, and its targets; None: none here.

    Control packets, migrations and letters to tasks are checked later, when their target is known.
    """
    channel, kind = packet.channel, packet.type
    if channel == SYSCTRL and kind in _CONTROL_TYPES:
        return None
    if channel == CTRL:
        return "command", (packet.destination, kind)
    if channel == NETWORK:
        if kind.startswith(_AMONG_ITSELF):
            return None
    return "publish", (channel,)


class Access:
    """The rights of the peers of one agent.

    A peer with a certificate has the rights in the rules of the roster. Any other peer came by `local://`, or to an
    agent that is `insecure`: it has all rights, or those in the agent's own file.

    Args:
        agent: the agent.
        roster: returns the known roster; None: the agent has no keys.
        own: the rules of the agent's own file for peers without a certificate; None: they have all rights.
        refused: rights that the agent's own file refuses to all peers.
    """

    def __init__(
        self,
        agent: str,
        roster: Callable[[], Roster | None] | None = None,
        own: Sequence[AccessRule] | None = None,
        refused: Sequence[Right] = (),
    ) -> None:
        self._agent = agent
        self._roster = roster
        self._own = own
        self._refused = frozenset(refused)
        self._known: dict[tuple[Bearer, Right, tuple[str, ...]], bool] = {}
        self._known_of: Roster | None = None
        self.bearer_of: Callable[[str], tuple[Bearer, bool] | None] = lambda peer: None
        """Takes a peer; returns its bearer, and whether that is certified; None: it has no link."""

    def fault(self, peer: str, right: Right, *on: str) -> str:
        """Return why a peer may not do something, as a sentence; empty: it may. Any thread.

        Args:
            peer: the name of the peer; the agent itself has all rights.
            right: the right that it needs.
            on: the target of the right; if it has several names, one of them is enough.
        """
        if peer == self._agent:
            return ""
        found = self.bearer_of(peer)
        if found is not None:
            return self.fault_of(*found, right, on)
        if self._roster is None and self._own is None and not self._refused:
            return ""
        return f"{self._agent} has no link to {peer} any more, so the rights of {peer} are not known"

    def fault_of_packet(self, who: Bearer, certified: bool, peer: str, packet: Packet) -> str:
        """Return why a packet is refused, as a sentence; empty: it is not. In the transport's thread.

        Args:
            who: the peer.
            certified: whether a certificate proves it.
            peer: its name on the mesh.
            packet: the packet, whose source was checked.
        """
        if not certified and self._own is None and not self._refused:
            return ""
        if agent_of(packet.source) != peer and (fault := self.fault_of(who, certified, "replay", (packet.channel,))):
            return fault
        needed = needs(packet)
        return self.fault_of(who, certified, *needed) if needed is not None else ""

    def fault_of(self, who: Bearer, certified: bool, right: Right, on: tuple[str, ...]) -> str:
        """As `fault`, of a bearer."""
        if right in self._refused:
            return f"{self._agent} lets no peer do this: its own file refuses the right {right!r}"
        if not certified:
            if self._own is None or allows(self._own, who, right, on, self._agent):
                return ""
            return f"{self._lacks(who, right, on)} (the [access] of its own file)"
        roster = self._roster() if self._roster is not None else None
        if roster is not self._known_of or len(self._known) > _MOST_KNOWN:
            self._known, self._known_of = {}, roster
        known = self._known.get((who, right, on))
        if known is None:
            known = roster is not None and allows(roster.allow, who, right, on, self._agent)
            self._known[who, right, on] = known
        if known:
            return ""
        number = roster.number if roster is not None else 0
        grant = f"pancakes keys allow {who.name} {right} --on '{on[0]}' --agent {self._agent}"
        return f"{self._lacks(who, right, on)} (roster {number}). To grant it: {grant}"

    def _lacks(self, who: Bearer, right: Right, on: tuple[str, ...]) -> str:
        return f"{self._agent} does not let {who.name} ({who.role}) do this: it lacks the right {right!r} on {on[0]!r}"
