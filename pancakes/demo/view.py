"""What a person sees of a mission while it runs: a live table in a terminal, or plain lines."""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any, TextIO

from pancakes.demo.conductor import Mission
from pancakes.demo.demo import Demo

REFRESH_HZ = 8
SHOWN_EVENTS = 14
BEHIND_S = 0.25
"""A world that lies further behind the clock than this, in mission seconds, is said to."""
QUIET = (
    "peer_up",
    "peer_down",
    "service_started",
    "service_stopped",
    "ready",
    "roster",
    "task_frozen",
    "safe_hold",
)
"""Kinds of events that a person need not see; they are in the file."""


def sentence_of(record: Mapping[str, Any]) -> str:
    """Returns an event as a short line; empty where a person need not see it."""
    kind = record["kind"]
    if kind in QUIET or record.get("service") in ("device", "network", "log"):
        return ""
    who = str(record["agent"])
    if kind == "line":
        return f"{who}: {record['text']}" if record["level"] in ("warning", "error") else ""
    if kind == "task_started":
        return f"{who} runs {record['task']}"
    if kind == "task_stopped":
        return f"{who} stopped {record['task']}: {record['reason']}"
    if kind == "migration_asked":
        return f"{who} asks all neighbours to take {record['task']}"
    if kind == "migration_bid":
        return f"{who} bids {record['cost']:g} for {record['task']}"
    if kind == "migration_refused":
        return f"{who} refuses {record['task']}: {record['reason']}"
    if kind == "migration":
        return f"{record['task']} {record['outcome']}" + (f" to {record['winner']}" if record["winner"] else "")
    if kind == "task_arrived":
        return f"{who} took {record['task']} from {record['source_agent']} with its state"
    if kind == "rate_changed":
        return f"{who} runs {record['task']} at {record['rate_hz']:g} Hz, asked by {record['by']}"
    if kind == "collision":
        return f"collision: {' and '.join(record['names'])}"
    rest = ", ".join(f"{key} {_short(value)}" for key, value in record.items() if key not in _ENVELOPE)
    return f"{who}: {kind.replace('_', ' ')}" + (f" ({rest})" if rest else "")


_ENVELOPE = ("t_s", "agent", "source", "kind")


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


class PlainView:
    """One line for each event, for logs and pipes."""

    def __init__(self, demo: Demo, mission: Mission, out: TextIO | None = None) -> None:
        self._out = out or sys.stdout
        self._lock = threading.Lock()
        self._said_behind_s = 0.0
        self._mission = mission
        mission.told = self.tell
        mission.changed = self._look

    def __enter__(self) -> PlainView:
        return self

    def __exit__(self, *error: object) -> None:
        self._mission.told = lambda record: None
        self._mission.changed = lambda: None

    def tell(self, record: Mapping[str, Any]) -> None:
        """Writes one event."""
        sentence = sentence_of(record)
        if sentence:
            self._say(f"{record['t_s']:8.2f} s  {sentence}")

    def _look(self) -> None:
        behind_s = self._mission.behind_s
        if behind_s > max(BEHIND_S, 2 * self._said_behind_s):
            self._said_behind_s = behind_s
            self._say(f"{self._mission.now_s:8.2f} s  the world lies {behind_s:.2f} s behind the clock")

    def _say(self, text: str) -> None:
        with self._lock:
            print(text, file=self._out, flush=True)


class LiveView:
    """A table that is drawn anew several times a second."""

    def __init__(self, demo: Demo, mission: Mission) -> None:
        from rich.console import Console
        from rich.live import Live

        self._demo = demo
        self._mission = mission
        self._lines: deque[str] = deque(maxlen=SHOWN_EVENTS)
        mission.told = self._tell
        self._live = Live(
            get_renderable=self._render, console=Console(), refresh_per_second=REFRESH_HZ, transient=False
        )

    def __enter__(self) -> LiveView:
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._mission.told = lambda record: None
        self._live.__exit__(None, None, None)

    def _tell(self, record: Mapping[str, Any]) -> None:
        sentence = sentence_of(record)
        if sentence:
            self._lines.append(f"{record['t_s']:8.2f} s  {sentence}")

    def _render(self) -> Any:
        from rich import box
        from rich.console import Group
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        mission = self._mission
        table = Table(box=box.SIMPLE_HEAD, expand=True, pad_edge=False)
        for title in ("agent", "runs", *(("wheels follow",) if self._demo.circled else ())):
            table.add_column(title)
        for title in ("battery", *(("to the circle",) if self._demo.circled else ()), "position"):
            table.add_column(title, justify="right")
        for agent in mission.agents:
            table.add_row(*self._row(agent))
        behind = f", {mission.behind_s:.1f} s behind" if mission.behind_s > BEHIND_S else ""
        if mission.phase == "connecting":
            waiting = "; ".join(f"{agent} {why}" for agent, why in list(mission.waiting_for.items()))
            head = f"waiting for the agents: {waiting or 'they send what happens'}"
        else:
            head = f"{mission.now_s:6.1f} of {mission.duration_s:.0f} s{behind}"
        # The last lines only, as plain text: what plug-ins say is no markup.
        events = Text("\n".join(self._lines) or "nothing has happened yet", no_wrap=True, overflow="ellipsis")
        return Group(
            Panel(Group(Text(head, style="bold"), table), title=self._demo.title), Panel(events, title="events")
        )

    def _row(self, agent: str) -> tuple[str, ...]:
        mission = self._mission
        body = mission.bodies.get(agent)
        battery = mission.batteries.get(agent)
        follows = (body.driven_by if body is not None else "",) if self._demo.circled else ()
        distance = (self._distance(body),) if self._demo.circled else ()
        return (
            agent,
            ", ".join(mission.running.get(agent, ())),
            *follows,
            f"{battery.voltage_v:.2f} V {battery.level:4.0%}" if battery is not None else "",
            *distance,
            f"{body.x_m:+.2f} {body.y_m:+.2f} m" if body is not None else "",
        )

    def _distance(self, body: Any) -> str:
        centre = self._mission.bodies.get(self._demo.circled)
        if body is None or centre is None or body.kind != "robot":
            return ""
        off_m = math.hypot(body.x_m - centre.x_m, body.y_m - centre.y_m) - self._demo.radius_m
        return f"{off_m * 100:+6.1f} cm"
