"""Sample packets and descriptions of agents, for tests without agents."""

from __future__ import annotations

from typing import Any

from pancakes.client.rates import RateMeter
from pancakes.packet import Packet
from pancakes.sim.world_state import BodyState, WorldState


def packet(source: str, channel: str, type_: str, body: Any, stamp: float = 0.0, seq: int = 1, **others: Any) -> Packet:
    return Packet(channel, type_, source, "", stamp, seq, body, **others)


def world(time_s: float, **places: tuple[float, float]) -> Packet:
    """The state of a world with robots, by name."""
    bodies = tuple(
        BodyState(name, "robot", x_m, y_m, 0.5, 0.1, 0.0, 8.0, "Drive") for name, (x_m, y_m) in places.items()
    )
    return packet("world/client/World", "system", "world_state", WorldState(time_s, bodies), time_s)


def task(agent: str, name: str, service: str = "client", **others: Any) -> dict[str, Any]:
    """A row of an agent's description."""
    row = {
        "agent": agent,
        "service": service,
        "task": name,
        "type": f"x.{name}",
        "state": "running",
        "rest": "",
        "rate_hz": None,
    }
    counts = {"incarnation": 1, "reason": "", "ticks": 0, "lateness_sum_s": 0.0, "missed": 0, "dropped": 0}
    return {**row, **counts, **others}


def agent(
    name: str, *tasks: dict[str, Any], peers: dict[str, float | None] | None = None, **others: Any
) -> dict[str, Any]:
    """The result of `Describe` of an agent; `peers`: round trips in seconds."""
    links = [{"name": peer, "role": "agent", "rtt_s": rtt_s} for peer, rtt_s in (peers or {}).items()]
    return {
        "agent": name,
        "fleet": "test",
        "role": "agent",
        "ready": True,
        "held": False,
        "insecure": "",
        "roster": None,
        "speed": 1.0,
        "mission_s": 0.0,
        "devices": ["motors"],
        "services": [{"service": "client", "state": "running", "reason": ""}],
        "tasks": list(tasks),
        "dead_letters": 0,
        "undelivered": 0,
        "listen": "tcp://127.0.0.1:7401",
        "battery_level": None,
        "process": None,
        "mesh": {"peers": [*links, {"name": "cli-1", "role": "client", "rtt_s": 0.1}]},
        **others,
    }


def describe(model: Any, *agents: dict[str, Any], t: float = 0.0, rates: RateMeter | None = None) -> None:
    """Tell a model what agents say of themselves."""
    model.describe((rates or RateMeter()).update(agents), agents, t)


def record(agent: str, kind: str, t_s: float = 0.0, service: str = "client", **fields: Any) -> dict[str, Any]:
    """An event of an agent's log."""
    return {"t_s": t_s, "agent": agent, "source": f"{agent}/{service}", "kind": kind, **fields}
