"""`pancakes doctor`: find faults on this machine and in its agents, and print what to do."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.errors import UnreachableError
from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.output import show_text

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.tools.cli.verbs.checks import Facts, Finding

MARKS: Final = {"ok": ("ok", "green"), "warning": ("warning", "yellow"), "error": ("error", "red")}


@click.command()
@click.option("--no-machine", is_flag=True, help="Check only the agents.")
@asks_agents
def doctor(no_machine: bool, ask: Ask) -> None:
    """Look for faults on this machine and in its agents, and print what to do.

    It checks on the machine: Python and its libraries, plug-ins, the directories that agents use, open files, clock,
    loopback.
    It looks for agents that do not answer, are suspended, or have the same name or another version; peers that are
    away; services and tasks that were given up or are stuck; missed ticks and lost packets; actuators that refuse a
    task; wrong clocks (time of day, rate, mission time). The exit code is 1 if it finds an error.

    \b
    Example:
        pancakes doctor
        pancakes doctor --at 192.168.1.20:7401 --no-machine --format json
    """
    found: list[Finding] = []
    for finding in _look(not no_machine, ask):
        found.append(finding)
        if not ask.printer.is_json:
            _print(finding)
    count = Counter(finding.level for finding in found)
    ask.printer.emit(
        [asdict(finding) for finding in found],
        f"errors: {count['error']}, warnings: {count['warning']}, in order: {count['ok']}",
    )
    sys.exit(REFUSED if any(finding.level == "error" for finding in found) else OK)


def _print(finding: Finding) -> None:
    word, colour = MARKS[finding.level]
    show_text(f"{finding.about}: {finding.text}", head=click.style(f"{word:8}", fg=colour) + " ")
    if finding.advice:
        show_text(f"{'':8} → {finding.advice}")


def _look(machine: bool, ask: Ask) -> Iterator[Finding]:
    from pancakes.tools.cli.verbs.agent_checks import check_agents
    from pancakes.tools.cli.verbs.checks import Finding

    if machine:
        from pancakes.tools.cli.verbs.machine_checks import check_machine

        yield from check_machine()
    with ask.client() as client:
        facts = _ask_agents(ask, client)
        yield from [facts] if isinstance(facts, Finding) else check_agents(facts)


def _ask_agents(ask: Ask, client: Client) -> Facts | Finding:
    """Ask all agents for the facts that the checks need; return a finding if no agent runs here."""
    from pancakes.control import Describe, Guarding
    from pancakes.errors import PancakesError
    from pancakes.security.key_store import rosters_here
    from pancakes.tools.cli.verbs.checks import Facts, Finding
    from pancakes.tools.cli.verbs.task_recovery import fences_of
    from pancakes.util.clock import wall_ns
    from pancakes.util.runtime_dir import entries, other_fleets, why_none

    here = []
    if not ask.where.addresses:
        fleet = ask.where.fleet
        try:
            here = [it for it in entries() if it.role != "client" and fleet in ("", it.fleet)]
        except PancakesError as error:
            return Finding("error", "agents", str(error), "fix that: without it no agent of this machine can be found")
        if not here and fleet and other_fleets(fleet):
            return Finding("error", "agents", why_none(fleet), "pass one of those as --fleet, or leave it out")
        if not here:
            return Finding("ok", "agents", f"no agent{f' of the fleet {fleet}' if fleet else ''} runs on this machine")
    now_s = wall_ns() / 1e9
    try:
        found = client.describe()
    except UnreachableError as error:
        return Facts(silent=str(error).splitlines(), entries=here)
    guarded = client.request_all(Guarding(), *(agent["agent"] for agent in found.agents))

    def describe(agent: str, target: str) -> Any:
        try:
            return client.request(agent, Describe(target)).result
        except PancakesError:
            return None

    def fences(agent: str, target: str) -> list[dict[str, Any]]:
        try:
            return fences_of(client, agent, target)
        except PancakesError:
            return []  # the agent or the task has gone since

    return Facts(
        agents=found.agents,
        silent=found.silent,
        asleep=found.asleep,
        entries=here,
        guards=[row for _, reply in guarded.replies if reply.ok for row in reply.result],
        rosters=rosters_here(),
        now_s=now_s,
        describe=describe,
        fences=fences,
    )
