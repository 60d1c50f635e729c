"""Nobody speaks for another: whose packets a link may bring. Pure."""

from __future__ import annotations

from pancakes.packet import CORE_CHANNELS, SYSTEM, agent_of


def fault_of_source(peer: str, role: str, channel: str, source: str) -> str:
    """Returns why a peer may not send packets of this source, as a sentence; empty where it may.

    The packets of an agent come over the link to that agent alone. But a terminal replays what others once said
    (`pancakes replay`), on `system` and on channels that are no core channels.

    Args:
        peer: the name of the agent, or terminal, at the other end of the link.
        role: its role.
        channel: the channel of the packets.
        source: their source.
    """
    if agent_of(source) == peer or (role == "client" and may_be_replayed(channel)):
        return ""
    return f"{peer} ({role}) sends packets of {source} on {channel!r}, and may speak for itself alone"


def may_be_replayed(channel: str) -> bool:
    """Returns whether a terminal may send what others said on this channel."""
    return channel == SYSTEM or channel not in CORE_CHANNELS
