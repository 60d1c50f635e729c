"""Show a mission while it runs: as a live table in a terminal, or as plain lines."""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any, TextIO

from pancakes.client.rows import is_quiet, sentence_of
from pancakes.tools.demo.conductor import BEHIND_S, Mission
from pancakes.tools.demo.demo import Demo
from pancakes.util.text import printable

REFRESH_HZ = 8
SHOWN_EVENTS = 14
FRAME_LINES = 3
"""The lines of the terminal that the frame around the events and the line below it take."""


class PlainView:
    """Print one line for each event, for logs and pipes."""

    def __init__(self, demo: Demo, mission: Mission, out: TextIO | None = None) -> None:
        self._out = out or sys.stdout
        self._lock = threading.Lock()
        self._reported_behind_s = 0.0
        self._mission = mission
        mission.told = self.tell
        mission.changed = self._look

    def __enter__(self) -> PlainView:
        return self

    def __exit__(self, *error: object) -> None:
        self._mission.told = lambda record: None
        self._mission.changed = lambda: None

    def tell(self, record: Mapping[str, Any]) -> None:
        """Print one event."""
        if not is_quiet(record):
            self._say(f"{record['t_s']:8.2f} s  {sentence_of(record)}")

    def _look(self) -> None:
        behind_s = self._mission.behind_s
        if behind_s > max(BEHIND_S, 2 * self._reported_behind_s):
            self._reported_behind_s = behind_s
            self._say(f"{self._mission.now_s:8.2f} s  the world is {behind_s:.2f} s behind the clock")

    def _say(self, text: str) -> None:
        with self._lock:
            print(printable(text), file=self._out, flush=True)


class LiveView:
    """Draw a table several times per second. Meanwhile nothing else may write to the terminal.

    Args:
        demo: the demo.
        mission: its mission, which is updated while it runs.
        page: the address of the page, to be kept visible; empty: no page.
    """

    def __init__(self, demo: Demo, mission: Mission, page: str) -> None:
        from rich.console import Console
        from rich.live import Live

        self._demo = demo
        self._mission = mission
        self._page = page
        self._lines: deque[str] = deque(maxlen=SHOWN_EVENTS)
        mission.told = self._tell
        self._console = Console()
        self._live = Live(
            get_renderable=self._render, console=self._console, refresh_per_second=REFRESH_HZ, transient=False
        )

    def __enter__(self) -> LiveView:
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._mission.told = lambda record: None
        self._live.__exit__(None, None, None)

    def _tell(self, record: Mapping[str, Any]) -> None:
        if not is_quiet(record):
            self._lines.append(printable(f"{record['t_s']:8.2f} s  {sentence_of(record)}"))

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
            head = f"waiting for the agents: {printable(waiting) or 'they subscribe the launcher'}"
        else:
            head = f"{mission.now_s:6.1f} of {mission.duration_s:.0f} s{behind}"
        above: list[Any] = [Text(head, style="bold", no_wrap=True, overflow="ellipsis")]
        if self._page:
            above.append(Text(f"the page is at {self._page}", overflow="fold"))
        upper = Panel(Group(*above, table), title=self._demo.title)
        # Show as many of the last lines as fit. They are plain text, because plug-ins do not write rich's markup.
        used = len(self._console.render_lines(upper, pad=False)) + FRAME_LINES
        lines = list(self._lines)[-max(1, min(SHOWN_EVENTS, self._console.height - used)) :]
        events = Text("\n".join(lines) or "nothing has happened yet", no_wrap=True, overflow="ellipsis")
        return Group(upper, Panel(events, title="events"))

    def _row(self, agent: str) -> tuple[str, ...]:
        mission = self._mission
        body = mission.bodies.get(agent)
        battery = mission.batteries.get(agent)
        follows = (body.driven_by if body is not None else "",) if self._demo.circled else ()
        distance = (self._distance(body),) if self._demo.circled else ()
        return (
            agent,
            printable(", ".join(mission.running.get(agent, ()))),
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
