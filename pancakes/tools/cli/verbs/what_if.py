"""`pancakes what-if migrate|rate|without|allocate`: show what a change would do, before you make it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click
import msgspec

from pancakes.control import LONGEST_S, SHORTEST_S, Allocate, Describe, Measure, Migrate, Reschedule
from pancakes.errors import ControlRefusedError, RemoteProtocolError
from pancakes.tools.cli.agent_requests import request, request_result, resolve_service
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import (
    AGENT_NAME,
    Ask,
    Duration,
    FiniteRange,
    TakesNumbers,
    TaskName,
    a_task,
    asks_agents_for,
    the_agent,
)
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.verbs.task_arguments import costs
from pancakes.util import codecs

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.tools.forecast import Expected, Forecast, MeasuredAgent

_F = TypeVar("_F", bound=Callable[..., Any])

BIDDING_S: Final = 10.0
"""The time limit for answers to requests that collect bids."""
ALLOCATING_S: Final = 20.0
"""The time limit for the answer to a request for a round of the allocation."""
NO_SOLVER: Final = "the extra `allocation` is not installed on {agent}, or there are too many tasks"
KEPT_APART: Final = ("device", "network", "log")
"""The services whose tasks never migrate."""


class MeasuredTime(Duration):
    """A time such as `5s`, within the limits of a measurement."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        for_s = super().convert(value, param, ctx)
        if not SHORTEST_S <= for_s <= LONGEST_S:
            self.fail(f"a measurement takes {SHORTEST_S:g} to {LONGEST_S:g} s, not {for_s:g} s", param, ctx)
        return for_s


_for_option = click.option(
    "--for", "for_s", metavar="TIME", type=MeasuredTime(), default=5.0, help="How long to measure. [default: 5s]"
)
_cost_option = click.option(
    "--cost",
    metavar="NAME",
    default="tasks",
    show_default=True,
    shell_complete=costs,
    help="The cost function to bid with.",
)


SECTIONS: Final = {
    "Commands": {
        "migrate": "Show what a migration would do.",
        "rate": "Show what another rate of a task would do.",
        "without": "Show what would happen if an agent left.",
        "allocate": "Show which tasks the team would migrate now.",
    },
}


@click.group("what-if", cls=SectionedGroup, sections=SECTIONS)
def what_if() -> None:
    """Show what a change would do to loads, missed ticks and batteries, before you make it.

    All agents measure for some seconds the processor time of each turn of each task. The forecast follows from these
    figures, with bounds, and says what it is based on. Nothing is changed.
    """


@what_if.command()
@a_task
@click.option(
    "--to",
    metavar="AGENT",
    type=AGENT_NAME,
    default="",
    help="The destination. [default: the agent with the lowest bid]",
)
@_cost_option
@_for_option
@asks_agents_for(BIDDING_S)
def migrate(name: TaskName, to: str, cost: str, for_s: float, ask: Ask) -> None:
    """Show what the migration of a running task to another agent would do.

    The neighbours are asked for bids first, as in the migration itself. The exit code is 1 if none would take the task.

    \b
    Example:
        pancakes what-if migrate agent1/ScanTarget
        pancakes what-if migrate agent1/ScanTarget --to agent2 --for 20s
    """
    from pancakes.tools.forecast import forecast_move

    with ask.client() as client:
        name = resolve_service(client, name)
        ledger = _bids(client, name.agent, name.target, to, cost)
        fleet = _measured(client, ask, for_s)
    winner = str(ledger["winner"])
    forecast = forecast_move(fleet, name.agent, name.task, winner, name.service)
    _show(f"{name} migrates to {winner}", forecast, ask.printer, {"bids": _bid_rows(ledger)})


@what_if.command(cls=TakesNumbers)
@a_task
@click.argument("rate_hz", metavar="HZ", type=FiniteRange(min=0.0))
@click.option("--timer", metavar="NAME", default="", help="The timer, if the task has several. [default: the first]")
@_for_option
@asks_agents_for(BIDDING_S)
def rate(name: TaskName, rate_hz: float, timer: str, for_s: float, ask: Ask) -> None:
    """Show what another rate of a running task would do; HZ is in ticks per second of mission time.

    \b
    Example:
        pancakes what-if rate agent1/ScanTarget 20
    """
    from pancakes.tools.forecast import forecast_rate

    with ask.client() as client:
        name = resolve_service(client, name)
        request(client, name.agent, Reschedule(name.target, rate_hz, timer, dry_run=True))
        fleet = _measured(client, ask, for_s)
    forecast = forecast_rate(fleet, name.agent, name.task, rate_hz, timer, name.service)
    _show(f"{name} ticks at {rate_hz:g} Hz", forecast, ask.printer, {})


@what_if.command()
@the_agent
@_cost_option
@_for_option
@asks_agents_for(BIDDING_S)
def without(agent: str, cost: str, for_s: float, ask: Ask) -> None:
    """Show what would happen if an agent left and its tasks migrated before, each to its present lowest bid.

    A task that no other agent takes, or that cannot migrate, ends with the agent. The later bids may differ: a cost may
    depend on the tasks that an agent has taken meanwhile.

    \b
    Example:
        pancakes what-if without agent1
    """
    from pancakes.tools.forecast import forecast_without

    with ask.client() as client:
        described = request_result(client, agent, Describe())
        running = [
            f"{row['service']}/{row['task']}"
            for row in described["tasks"]
            if row["state"] == "running" and row["service"] not in KEPT_APART
        ]
        places, rows = {}, []
        for target in running:
            try:
                ledger = _bids(client, agent, target, "", cost)
            except ControlRefusedError as error:
                rows.append({"task": target, "goes to": "", "cost": None, "reason": str(error)})
                continue
            places[target] = str(ledger["winner"])
            (bid,) = [line for line in ledger["lines"] if line["peer"] == ledger["winner"]]
            rows.append({"task": target, "goes to": places[target], "cost": bid["cost"], "reason": ""})
        fleet = _measured(client, ask, for_s)
    _show(f"{agent} leaves", forecast_without(fleet, agent, places), ask.printer, {"tasks": rows})


@what_if.command()
@the_agent
@asks_agents_for(ALLOCATING_S)
def allocate(agent: str, ask: Ask) -> None:
    """Show which tasks the team would migrate now, if AGENT began a round of the allocation.

    All agents that take part bid as in the allocation itself, and nothing is migrated. With the extra `allocation`
    installed on AGENT, the answer includes how far the result is from the best allocation.

    \b
    Example:
        pancakes what-if allocate agent1
    """
    with ask.client() as client:
        report = request_result(client, agent, Allocate(dry_run=True))
    rows = [
        {
            "task": line["task"],
            "is on": line["owner"],
            "then on": line["winner"] or line["owner"],
            "bid": line["bid"],
            "bids": ", ".join(f"{name} {bid:g}" for name, bid in sorted(line["bids"].items(), key=_best_first)),
            "reason": "; ".join([*([line["reason"]] if line["reason"] else []), *_refusals(line["refusals"])]),
        }
        for line in report["lines"]
    ]
    facts = [f"worth {report['value']:g}; if nothing is migrated, {report['present']:g}"]
    if report["optimum"] is None:
        facts.append(f"how far that is from the best allocation is not known: {NO_SOLVER.format(agent=agent)}")
    else:
        facts.append(f"{report['gap']:.1%} below the best allocation, which is worth {report['optimum']:g}")
    notes = [f"{name} is left out: {why}" for name, why in report["ignored"].items()]
    notes += [f"{name} takes no part" for name in report["silent"]]
    if not report["agreed"]:
        notes.append("the agents did not agree in time: some packets were lost, or a link is slow")
    sections = {"Tasks": rows, "Allocation": "\n".join(facts), "Notes": "\n".join(notes)}
    ask.printer.emit(report, sections)


def _best_first(item: tuple[str, float]) -> tuple[float, str]:
    return -item[1], item[0]


def _refusals(refusals: Mapping[str, str]) -> list[str]:
    return [f"{name} {why}" for name, why in refusals.items()]


def _bids(client: Client, agent: str, target: str, to: str, cost: str) -> Mapping[str, Any]:
    """Return the ledger of a dry run of a migration.

    Raises:
        ControlRefusedError: no agent would take the task; the message is the reason.
    """
    ledger: Mapping[str, Any] = request(client, agent, Migrate(target, to, "", cost, dry_run=True)).result
    return ledger


def _bid_rows(ledger: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "neighbour": line["peer"],
            "answer": line["answer"],
            "cost": line["cost"],
            "terms": ", ".join(f"{name} {value:g}" for name, value in line["terms"].items()),
            "reason": line["reason"],
        }
        for line in ledger["lines"]
    ]


def _measured(client: Client, ask: Ask, for_s: float) -> list[MeasuredAgent]:
    """Measure all reachable agents at the same time; print to standard error those that do not answer."""
    from pancakes.tools.forecast import MeasuredAgent

    show_text(f"measuring for {for_s:g} s ...", err=True)
    found = client.request_all(Measure(for_s), timeout_s=for_s + ask.timeout_s)
    for sentence in [*found.silent, *(f"{agent} refused: {it.reason}" for agent, it in found.replies if not it.ok)]:
        show_text(sentence, err=True)
    figures = []
    for agent, reply in found.replies:
        if not reply.ok:
            continue
        try:
            figures.append(codecs.convert(reply.result, MeasuredAgent))
        except msgspec.ValidationError as error:
            raise RemoteProtocolError(
                f"the answer of {agent} cannot be read here, so {agent} runs another version: {error}"
            ) from None
    return figures


def _show(change: str, forecast: Forecast, printer: Printer, more: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    rows = [
        {
            "agent": it.agent,
            "load": round(it.load, 4),
            "load then": _expected(it.load_after),
            "host": round(it.host_load, 4),
            "host then": _expected(it.host_load_after),
            "missed/s": round(it.missed_hz, 3),
            "missed/s then": _expected(it.missed_hz_after),
            "battery": _left(it.battery_s),
            "battery then": _left(it.battery_after_s),
        }
        for it in forecast.agents
    ]
    titles = {"bids": "Bids", "tasks": "Its tasks"}
    tables = {titles[key]: value for key, value in more.items()}
    sure = [
        f"{it.agent}: load {_share(it.load_after.sure_share)}, host {_share(it.host_load_after.sure_share)}"
        for it in forecast.agents
        if it.load_after.value or it.load_after.high
    ]
    facts = {"Based on": "\n".join(forecast.known_from), "Uncertainty": "\n".join(sure)}
    sections = {**tables, f"If {change}": rows, **facts, "Notes": "\n".join(forecast.notes)}
    printer.emit({"change": change, **asdict(forecast), **more}, sections)


def _share(share: float) -> str:
    return f"±{100 * share:.1f} %" if share <= 1.0 else "unknown"


def _expected(expected: Expected) -> str:
    value, low, high = (f"{it:.3f}".rstrip("0").rstrip(".") for it in (expected.value, expected.low, expected.high))
    return value if low == high else f"{value} ({low} to {high})"


def _left(left_s: float | Expected | None) -> str:
    """Return how long a battery lasts, in words."""
    if left_s is None:
        return "unknown"
    if isinstance(left_s, (int, float)):
        minutes = left_s / 60.0
        return f"{minutes / 60.0:.1f} h" if minutes >= 120.0 else f"{minutes:.0f} min"
    low, high = _left(left_s.low), _left(left_s.high)
    return low if low == high else f"{low} to {high}"
