"""What an agent says of itself, in short."""

from __future__ import annotations

import msgspec


class AgentRow(msgspec.Struct, frozen=True, kw_only=True):
    """An agent that answers.

    Attributes:
        agent, fleet: its name, and that of its fleet.
        role: `agent` or `environment`.
        ready: whether all its services have begun.
        held: whether its mission is held at 0.
        mission_s: the time of its mission.
        speed: mission seconds for each second of host time.
        battery_level: from 0 to 1; None: it has no battery.
        devices: the types of its devices.
        channels: its channels, the core channels first.
        neighbours: the agents that it is connected to.
    """

    agent: str
    fleet: str
    role: str
    ready: bool
    held: bool
    mission_s: float
    speed: float
    battery_level: float | None = None
    devices: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    neighbours: tuple[str, ...] = ()
