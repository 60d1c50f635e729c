"""Why a packet cannot go to its agent. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pancakes.errors import LocalProtocolError, PancakesError, PeerLost
from pancakes.packet import Packet, agent_of


def why_lost(
    packet: Packet, own: str, sleeps: bool, asleep: Mapping[str, float], there: Sequence[str]
) -> PancakesError:
    """Returns why a packet cannot go to its agent.

    Args:
        packet: the packet.
        own: the name of this agent.
        sleeps: whether its network sleeps.
        asleep: the peers that sleep, and for how many more seconds.
        there: the peers that are linked.
    """
    name = agent_of(packet.destination)
    what = f"the packet {packet.type!r} of {packet.source}"
    if name == own or not name:
        return LocalProtocolError(f"{what} is not for another agent, so the mesh cannot send it")
    if sleeps:
        return PeerLost(f"{what} cannot go to {name}: the network of {own} sleeps")
    if name in asleep:
        return PeerLost(f"{what} cannot go to {name}: it sleeps for another {asleep[name]:.1f} s")
    linked = ", ".join(there) or "no other agent"
    return PeerLost(f"{what} cannot go to {name}: {own} has no link to it (it is connected to {linked})")
