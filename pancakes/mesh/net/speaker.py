"""Each agent speaks for itself alone: whose packets a link may bring. Pure."""

from __future__ import annotations

from pancakes.packet import CORE_CHANNELS, SYSTEM, Packet, agent_of


def fault_of_source(own_role: str, peer: str, role: str, packet: Packet) -> str:
    """Returns why a peer may not send packets of the source of this one, as a sentence; empty where it may.

    The packets of an agent come over the link to that agent alone. But on `system`, and on channels that are no core
    channels, a client replays what others once said (`pancakes replay`), and follows what others say to its peer.

    Args:
        own_role: the role of this agent.
        peer: the name of the agent, or terminal, at the other end of the link.
        role: its role.
        packet: one of the packets, which have one source and one channel.
    """
    source, channel = packet.source, packet.channel
    if agent_of(source) == peer or ("client" in (own_role, role) and may_be_replayed(channel)):
        return ""
    return f"{peer} ({role}) sends packets of {source} on {channel!r}, and may speak for itself alone"


def may_be_replayed(channel: str) -> bool:
    """Returns whether a terminal may send what others said on this channel."""
    return channel == SYSTEM or channel not in CORE_CHANNELS
