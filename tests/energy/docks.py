"""A simulated fleet with docks: robots that measure their reserve, and docks with agents of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pancakes.packet import Packet
from pancakes.testing import Fleet

BUS = "tcp://bus:7499"
NEED = {"capacity_j": 200.0, "level": 0.4, "packet_j": 0.0, "noise_v": 0.0}


def start_docks(
    fleet: Fleet,
    docks: Mapping[str, Mapping[str, Any]],
    robots: Mapping[str, Mapping[str, Any]],
    *,
    tasks: Mapping[str, Any] | None = None,
    charges: bool = True,
    settings: Mapping[str, Any] | None = None,
    reserve: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
) -> None:
    """Start a world, its docks and its robots, and link them.

    Args:
        fleet: where.
        docks: the settings of each dock in the world.
        robots: likewise of each robot.
        tasks: tasks of every robot besides `Reserve` and `Charge`.
        charges: whether `Charge` is started at once.
        settings: those of `Charge`.
        reserve: those of `Reserve`, besides its defaults here.
        services: tables of services of every robot.
    """
    there = {"world": BUS}
    bodies = {name: {"spread_m": 0.0, "spread_rad": 0.0, "battery": NEED, **it} for name, it in robots.items()}
    world = {"bus": BUS, "robots": bodies, "docks": dict(docks)}
    fleet.start("world", tasks={"World": {"type": "sim.world", "settings": world}}, role="environment")
    for name in docks:
        dock = {"type": "sim.dock", "rate_hz": 2, "hold_after_mission_s": 2, "settings": there}
        fleet.start(name, devices={"dock": dock})
    devices = {
        "pose": {"type": "sim.pose", "rate_hz": 10, "settings": there},
        "motors": {"type": "sim.differential_drive", "settings": there},
        "battery": {"type": "sim.battery", "rate_hz": 2, "settings": there},
        "dock": {"type": "network.dock"},
    }
    told = {"level_per_m": 0.05, "window_s": 4.0, "rise_s": 10.0, **(reserve or {})}
    own = {
        "Reserve": {"type": "energy.reserve", "settings": told},
        "Charge": {"type": "energy.charge", "start": charges, "settings": dict(settings or {})},
    }
    for name in robots:
        fleet.start(name, devices=devices, tasks={**own, **(tasks or {})}, services=services)
    fleet.connect()


def states_of(fleet: Fleet, dock: str) -> list[tuple[str, str]]:
    """Follow a dock; return the list to which each change of (state, robot) is added."""
    seen: list[tuple[str, str]] = []

    def see(packet: Packet) -> None:
        now = (packet.body.state, packet.body.robot)
        if packet.source == f"{dock}/device/dock" and (not seen or seen[-1] != now):
            seen.append(now)

    fleet.agents[dock].kernel.stream.tap("system", see, ("dock_state",))
    return seen
