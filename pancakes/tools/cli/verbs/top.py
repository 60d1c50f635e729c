"""`pancakes top`: watch agents and tasks."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.client import Client, RateMeter
from pancakes.errors import UnreachableError
from pancakes.tools.cli.agent_requests import survey_with
from pancakes.tools.cli.options import Ask, Duration, asks_agents
from pancakes.tools.cli.options import agents as some_agents
from pancakes.tools.cli.output import one_line, show_drawn, show_text
from pancakes.tools.cli.streaming import until_ended
from pancakes.util.text import printable

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

Row = Mapping[str, Any]

AGENTS: Final = {
    "agent": "agent",
    "state": "state",
    "cpu %": "processor_share",
    "MiB": "memory_mib",
    "late ms": "lateness_s",
    "links": "links",
    "missed": "missed",
    "dropped": "dropped",
    "battery %": "battery_level",
}
"""The columns of the upper table, each with its key."""
TASKS: Final = {
    "task": "name",
    "state": "word",
    "wanted Hz": "rate_hz",
    "Hz": "achieved_hz",
    "late ms": "lateness_s",
    "missed": "missed",
    "dropped": "dropped",
    "restarts": "restarts",
}
"""The columns of the lower table, each with its key."""
SORTS: Final = {"name": "", "rate": "achieved_hz", "late": "lateness_s", "missed": "missed", "dropped": "dropped"}
"""The orders of tasks, each with the key whose largest values come first."""

SHORTEST_LOOK_S: Final = 0.5
"""The shortest time limit for an agent's answer, even if `--every` is shorter."""
SLOW: Final = 0.8
"""A task that reaches a smaller share of its wanted rate is highlighted."""


@click.command()
@some_agents
@click.option("--once", is_flag=True, help="Print one table, then exit.")
@click.option(
    "--every",
    "every_s",
    metavar="TIME",
    type=Duration(),
    default="1s",
    show_default=True,
    help="The period of updates; with --once, how long to measure.",
)
@click.option(
    "--sort",
    type=click.Choice(list(SORTS)),
    default="name",
    show_default=True,
    help="The order of the tasks: by name, or the largest value first.",
)
@asks_agents
def top(agents: tuple[str, ...], once: bool, every_s: float, sort: str, ask: Ask) -> None:
    """Watch all agents, or only those named, and their tasks, until Ctrl-C.

    For an agent it shows its share of one processor, its memory, the mean lateness of its tasks' ticks, its links to
    other agents, the missed ticks and the packets dropped from mailboxes since its tasks started, and its battery. For
    a task it shows the wanted rate, and the achieved rate over up to 10 s, or "-" after too few ticks. Rates and
    lateness are in mission time.
    JSON is a list of agents with --once, otherwise one agent per line at each update.

    \b
    Example:
        pancakes top
        pancakes top --once --every 5s --sort late
        pancakes top agent1 --once --format json
    """
    with until_ended(), ask.client() as client:
        looks = _looks(client, agents, every_s, once)
        if ask.printer.is_json:
            for rows in looks:
                if once:
                    ask.printer.emit([_sorted_in(row, sort) for row in rows])
                else:
                    for row in rows:
                        show_text(one_line(_sorted_in(row, sort)))
        elif once or not sys.stdout.isatty():
            for rows in looks:
                show_drawn(picture(rows, sort))
        else:
            _live(looks, sort)


def _looks(client: Client, agents: Sequence[str], every_s: float, once: bool) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of agents: at each update, or with `once` only after the second look."""
    meter = RateMeter()
    found = survey_with(client, *agents)
    due_s = client.now()
    rows = meter.update(found)
    while True:
        if not once:
            yield rows
        due_s = max(due_s + every_s, client.now())
        time.sleep(max(0.0, due_s - client.now()))
        try:
            # An agent that does not answer must not delay the next look at the others.
            limit_s = client.timeout_s if once else min(client.timeout_s, max(every_s, SHORTEST_LOOK_S))
            described = client.describe(*agents, timeout_s=limit_s).agents
        except UnreachableError:
            described = []
        rows = meter.update(described)
        if once:
            if not described:
                raise UnreachableError(f"{', '.join(row['agent'] for row in rows)} answered once, but not again")
            yield rows
            return


def _live(looks: Iterator[list[dict[str, Any]]], sort: str) -> None:
    from rich.console import Console
    from rich.live import Live

    console = Console()
    with Live(console=console, screen=True, auto_refresh=False) as live:
        for rows in looks:
            live.update(picture(rows, sort, console.size.height), refresh=True)


def picture(agents: Sequence[Row], sort: str, height: int | None = None) -> Group:
    """Return the two tables.

    Args:
        agents: the rows of `RateMeter`.
        sort: one of `SORTS`.
        height: the number of lines on the screen; None: no limit.
    """
    from rich.console import Group
    from rich.text import Text

    tasks = _sorted([task for agent in agents for task in agent["tasks"]], sort)
    shown_agents, shown_tasks = list(agents), tasks
    if height is not None:
        room = max(2, height - 6)  # headings and rules take 4 lines, one is empty, the last counts the hidden rows
        shown_agents = shown_agents[: max(1, room // 3, room - len(tasks))]
        shown_tasks = tasks[: max(1, room - len(shown_agents))]
    table = _table(AGENTS)
    for row in shown_agents:
        table.add_row(*(Text(printable(cell), _agent_style(row, column)) for column, cell in _cells(row, AGENTS)))
    lower = _table(TASKS)
    for row in shown_tasks:
        lower.add_row(*(Text(printable(cell), _task_style(row, column)) for column, cell in _cells(row, TASKS)))
    hidden = (len(agents) - len(shown_agents), len(tasks) - len(shown_tasks))
    foot = ", ".join(f"{count} more {what}" for count, what in zip(hidden, ("agents", "tasks"), strict=True) if count)
    return Group(table, Text(), lower, *([Text(f"and {foot}", "dim")] if foot else []))


def _table(columns: Mapping[str, str]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < 2 else "right", no_wrap=True)
    return table


def _cells(row: Row, columns: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    for column, key in columns.items():
        if key == "name":
            yield key, f"{row['agent']}/{row['service']}/{row['task']}"
        elif key == "word":  # the same word as in `pancakes task list`
            yield key, row["rest"] or row["state"]
        else:
            yield key, _cell(column, row[key])


def _cell(column: str, value: Any) -> str:
    if value is None:
        return "-"
    if column.endswith("%"):
        return f"{100.0 * value:.1f}"
    if column.endswith("ms"):
        return f"{1000.0 * value:.2f}"
    if column.endswith("MiB"):
        return f"{value:.0f}"
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _agent_style(row: Row, key: str) -> str:
    if row["state"] != "ready":
        return "red" if row["state"] == "no answer" else "yellow"
    if key in ("missed", "dropped") and row[key]:
        return "yellow"
    low = key == "battery_level" and row[key] is not None and row[key] < 0.2
    return "red" if low else "bold" if key == "agent" else ""


def _task_style(row: Row, key: str) -> str:
    if row["state"] in ("failed", "stuck"):
        return "red"
    if row["state"] != "running":
        return "dim"
    if key in ("missed", "dropped", "restarts") and row[key]:
        return "yellow"
    slow = key == "achieved_hz" and row[key] is not None and row[key] < SLOW * row["rate_hz"]
    return "red" if slow else ""


def _sorted(tasks: Sequence[Row], sort: str) -> list[Row]:
    by = SORTS[sort]
    by_name = sorted(tasks, key=lambda task: (task["agent"], task["service"], task["task"]))
    return sorted(by_name, key=lambda task: -(task[by] or 0.0)) if by else by_name


def _sorted_in(agent: Row, sort: str) -> dict[str, Any]:
    return {**agent, "tasks": _sorted(agent["tasks"], sort)}
