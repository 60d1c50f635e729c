"""A robot in virtual time, whose sensors say what a test lets them say; and the record of a made-up mission."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pancakes.sim.csv_records import Trajectory
from pancakes.testing import AgentHandle, Fleet
from pancakes.tools.demo import Run


class Crew:
    """A fleet of robots, and what a test says and hears there."""

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet

    def join(self, name: str, port: int, *peers: int, tables: str = "") -> None:
        """Starts an agent."""
        addresses = [f"tcp://127.0.0.1:{other}" for other in (port, *peers)]
        self.fleet.start(name, tables, listen=addresses[0], peers=tuple(addresses[1:]))
        self.run(1.0)

    def ear(self, agent: str) -> AgentHandle:
        return self.fleet.agents[agent]

    def say(self, agent: str, channel: str, body: Any, run_s: float = 0.05) -> None:
        """Publishes a packet on an agent, and lets everybody act on it."""
        self.ear(agent).publish(channel, body)
        self.run(run_s)

    def heard(self, agent: str, kind: type) -> list[Any]:
        """Returns the bodies of one class that were published on an agent so far."""
        return [packet.body for packet in self.ear(agent).probe.packets(kind)]

    def events(self, agent: str, kind: str) -> list[Mapping[str, Any]]:
        """Returns the fields of the events of one kind that were told on an agent so far."""
        return self.ear(agent).events(kind)

    def run(self, duration_s: float) -> None:
        self.fleet.run_for(duration_s)


@pytest.fixture
def crew(fleet: Fleet) -> Crew:
    return Crew(fleet)


@dataclass
class MadeUp:
    """A mission as it should go, made up at 10 Hz; a test spoils one thing of it, and sees what the judge says."""

    out: Path
    end_s: float = 300.0
    handed_over_s: float = 150.0
    radius_m: float = 0.55
    gap_s: float = 0.1
    off_m: float = 0.0
    parked_at: tuple[float, float] = (1.42, 1.01)
    path_of: dict[str, Callable[[float], tuple[float, float]]] = field(default_factory=dict)
    drives: dict[str, Callable[[float], str]] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    ended_because: str = ""
    configs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        moved = self.handed_over_s
        state = {"centre_m": [0.001, -0.002], "revolutions": 3.4}
        lines = [
            {"peer": "agent2", "answer": "bid", "fate": "won", "cost": 0.0, "terms": {}, "reason": ""},
            {"peer": "sensor", "answer": "refused", "fate": "refused", "cost": None, "reason": "lacks motors"},
        ]
        self.tell(0.0, "agent1", "roster", tasks=["ScanTarget", "PoseSharing", "BatteryWatchdog"])
        self.tell(0.0, "agent2", "roster", tasks=[])
        self.tell(0.0, "sensor", "roster", tasks=["MotionDetection"])
        self.tell(100.0, "agent1", "revolution", count=3)
        self.tell(moved, "agent1", "task_frozen", task="ScanTarget")
        self.tell(moved, "agent1", "task_stopped", task="ScanTarget", service="client", reason="handed over")
        self.tell(moved + 0.01, "agent2", "task_arrived", task="ScanTarget", source_agent="agent1", state=state)
        self.tell(moved + 0.01, "agent2", "task_started", task="ScanTarget", service="client")
        self.tell(moved + 0.02, "agent1", "task_started", task="GoHome", service="client")
        self.tell(moved + 0.02, "agent1", "migration", task="ScanTarget", outcome="moved", winner="agent2", lines=lines)
        self.path_of = {"agent1": self._first, "agent2": self._second, "sensor": lambda t_s: (0.0, 0.0)}
        self.path_of["mover"] = lambda t_s: (-1.2, math.sin(0.02 * t_s))
        self.drives = {
            "agent1": lambda t_s: "ScanTarget" if t_s < self.handed_over_s else "GoHome",
            "agent2": lambda t_s: "ScanTarget" if t_s > self.handed_over_s + self.gap_s - 0.05 else "",
        }
        robots = {"agent1": {"x_m": 1.4, "y_m": 1.0}, "agent2": {"x_m": 1.4, "y_m": -1.0}}
        arena = {"width_m": 4.0, "height_m": 3.0}
        world = {"robots": robots, "sensors": {"sensor": {}}, "movers": {"mover": {}}, "arena": arena}
        scan = {"type": "encirclement.ScanTarget", "settings": {"radius_m": self.radius_m}, "migrate": {"below": 0.65}}
        self.configs = {
            "world": {"tasks": {"World": {"type": "sim.world", "settings": world}}},
            "agent1": {"tasks": {"ScanTarget": scan, "GoHome": {"type": "encirclement.GoHome", "settings": {}}}},
            "agent2": {"tasks": {"GoHome": {"type": "encirclement.GoHome", "settings": {}}}},
            "sensor": {"tasks": {"MotionDetection": {"type": "encirclement.MotionDetection", "settings": {}}}},
        }

    def tell(self, t_s: float, agent: str, kind: str, **fields: Any) -> None:
        """Adds an event."""
        self.events.append({"t_s": t_s, "agent": agent, "source": f"{agent}/client", "kind": kind, **fields})

    def forget(self, kind: str, agent: str = "") -> None:
        """Takes the events of one kind away."""
        self.events = [event for event in self.events if event["kind"] != kind or agent not in ("", event["agent"])]

    def _circle(self, t_s: float) -> tuple[float, float]:
        radius = self.radius_m + self.off_m
        return radius * math.cos(-0.18 * t_s), radius * math.sin(-0.18 * t_s)

    def _first(self, t_s: float) -> tuple[float, float]:
        if t_s == 0.0:
            return 1.4, 1.0
        return self._circle(t_s) if t_s < self.handed_over_s + 20.0 else self.parked_at

    def _second(self, t_s: float) -> tuple[float, float]:
        return self._circle(t_s + 9.0) if t_s > self.handed_over_s + 12.0 else (1.4, -1.0)

    def write(self) -> Run:
        """Writes the mission's files, and returns the run that the judge is given."""
        rows = [Trajectory.header]
        for step in range(round(self.end_s * 10) + 1):
            t_s = step / 10
            for name, path in self.path_of.items():
                x_m, y_m = path(t_s)
                volts = f"{8.4 - 0.004 * t_s:.4f}" if name in self.drives else ""
                by = self.drives[name](t_s) if name in self.drives else ""
                rows.append(f"{t_s:.3f},{name},{x_m:.6f},{y_m:.6f},0.000000,0.100000,0.000000,{volts},{by}")
        self.out.mkdir(exist_ok=True)
        (self.out / "trajectory.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        lines = [json.dumps(event) + "\n" for event in sorted(self.events, key=lambda event: event["t_s"])]
        (self.out / "events.jsonl").write_text("".join(lines), encoding="utf-8")
        return Run(self.out, 7, self.end_s, self.end_s, self.ended_because, self.configs)


@pytest.fixture
def mission(tmp_path: Path) -> MadeUp:
    return MadeUp(tmp_path / "out")
