"""`pancakes doctor`: looks for what is wrong on this machine and with its agents, and says what to do."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.errors import Unreachable
from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.output import show_json, show_text

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.tools.cli.verbs.agent_checks import Finding

DEVICES: Final = "device"
"""The service that has the devices of an agent as its tasks."""
MARKS: Final = {"ok": ("ok", "green"), "warning": ("warning", "yellow"), "error": ("error", "red")}


@click.command()
@click.option("--no-machine", is_flag=True, help="Look only at the agents.")
@asks_agents
def doctor(no_machine: bool, ask: Ask) -> None:
    """Look for what is wrong on this machine and with its agents, and say what to do.

    On the machine: Python and its libraries, plug-ins, the directories that agents use, open files, clock, loopback.
    In agents: those that do not answer, are suspended, or have another's name or version; peers that are away;
    services and tasks that were given up or are stuck; missed ticks and lost packets; actuators that refuse a task;
    clocks that are off (time of day, rate, mission time). The exit code is 1 where there is an error.

    \b
    Example:
        pancakes doctor
        pancakes doctor --at 192.168.1.20:7401 --no-machine --format json
    """
    found: list[Finding] = []
    for finding in _look(not no_machine, ask):
        found.append(finding)
        if ask.format_ == "table":
            _print(finding)
    if ask.format_ == "json":
        show_json([asdict(finding) for finding in found])
    else:
        count = Counter(finding.level for finding in found)
        show_text(f"errors: {count['error']}, warnings: {count['warning']}, in order: {count['ok']}")
    sys.exit(REFUSED if any(finding.level == "error" for finding in found) else OK)


def _print(finding: Finding) -> None:
    word, colour = MARKS[finding.level]
    show_text(f"{finding.about}: {finding.text}", head=click.style(f"{word:8}", fg=colour) + " ")
    if finding.advice:
        show_text(f"{'':8} → {finding.advice}")


def _look(machine: bool, ask: Ask) -> Iterator[Finding]:
    if machine:
        from pancakes.tools.cli.verbs.machine_checks import check_machine
        from pancakes.util.plugins import Plugins

        yield from check_machine(Plugins())
    yield from _look_at_agents(ask)


def _look_at_agents(ask: Ask) -> Iterator[Finding]:
    from pancakes.control import Describe, Guarding
    from pancakes.errors import PancakesError
    from pancakes.security.key_store import rosters_here
    from pancakes.tools.cli.verbs.agent_checks import Finding, check_clocks, check_entries, check_fleet, check_guards
    from pancakes.util.clock import wall_ns
    from pancakes.util.runtime_dir import entries, other_fleets, why_none

    if not ask.where.addresses:
        try:
            there = [it for it in entries() if it.role != "client" and ask.where.fleet in ("", it.fleet)]
        except PancakesError as error:
            yield Finding("error", "agents", str(error), "without it no agent of this machine can be found")
            return
        if not there:
            fleet = ask.where.fleet
            if fleet and other_fleets(fleet):
                yield Finding("error", "agents", why_none(fleet), "say --fleet as one of those, or leave it out")
            else:
                yield Finding(
                    "ok", "agents", f"no agent{f' of the fleet {fleet}' if fleet else ''} runs on this machine"
                )
            return
        yield from check_entries(there)
    with ask.client() as client:
        asked_s = wall_ns() / 1e9
        try:
            found = client.survey()
        except Unreachable as error:
            for sentence in str(error).splitlines():
                yield Finding("error", "agents", sentence, "see whether it runs, and whether its computer is away")
            return

        def told(agent: str, target: str) -> Any:
            try:
                return client.request(agent, Describe(target)).result
            except PancakesError:
                return None

        yield from check_clocks(found.agents, asked_s)
        yield from check_fleet(found.agents, found.silent, told, found.asleep, rosters_here())
        guarded = client.request_all(Guarding(), *(agent["agent"] for agent in found.agents))
        yield from check_guards([row for _, reply in guarded.replies if reply.ok for row in reply.result])
        for agent in found.agents:
            yield from _look_at_fences(client, agent)


def _look_at_fences(client: Client, agent: dict[str, Any]) -> Iterator[Finding]:
    from pancakes.errors import PancakesError
    from pancakes.tools.cli.verbs.agent_checks import check_fences
    from pancakes.tools.cli.verbs.task_recovery import fences_of

    for task in agent["tasks"]:
        if task["service"] == DEVICES:
            try:
                yield from check_fences(fences_of(client, agent["agent"], f"{DEVICES}/{task['task']}"))
            except PancakesError:
                continue  # it has gone since
