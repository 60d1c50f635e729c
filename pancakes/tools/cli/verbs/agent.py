"""`pancakes agent ...`: run, list and show agents, reload their keys, and print their systemd units."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, Final

import click

from pancakes.control import ReloadKeys
from pancakes.tools.cli.agent_command import run_verb
from pancakes.tools.cli.agent_requests import ask_each, survey
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import Ask, agents, asks_agents, dry_run_option, format_option, orders_agents, the_agent
from pancakes.tools.cli.output import DRY_RUN, Printer
from pancakes.util.clock import utc_text

COLUMNS = ("agent", "role", "fleet", "address", "ready", "mission_s", "tasks", "neighbours")


SECTIONS: Final = {
    "Commands": {
        "run": "Run an agent, as pancakes-agent does.",
        "list": "List running agents.",
        "info": "Show all about an agent: process, links, load.",
        "reload-keys": "Make agents read their new keys.",
        "unit": "Print a systemd unit that runs an agent.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def agent() -> None:
    """Run, list and show agents."""


agent.add_command(run_verb())


@agent.command("list")
@agents
@click.option("--role", metavar="ROLE", default="", help="Only those in this role: agent, environment.")
@asks_agents
def list_(agents: tuple[str, ...], role: str, ask: Ask) -> None:
    """List the running agents, or only those named.

    An agent that does not answer in time is named on standard error; the exit code is 3 if none answers.

    \b
    Example:
        pancakes agent list
        pancakes agent list --at 192.168.1.20:7401 --format json
    """
    rows = [
        {
            **found,
            "address": ", ".join(found["listen"]),
            "mission_s": round(found["mission_s"], 3),
            "tasks": len(found["tasks"]),
        }
        for found in survey(ask, *agents)
        if role in ("", found["role"])
    ]
    ask.printer.table(rows, COLUMNS)


@agent.command()
@the_agent
@asks_agents
def info(agent: str, ask: Ask) -> None:
    """Show all that AGENT reports about itself: its process and load, its clock, links, services, devices, channels.

    JSON is a list with one entry: the unchanged answer of the agent.

    \b
    Example:
        pancakes agent info agent1
        pancakes agent info agent1 --format json
    """
    with ask.client() as client:
        (found,) = client.describe(agent).agents
    ask.printer.emit([found], _sections(found, client.is_own))


@agent.command("reload-keys")
@agents
@dry_run_option
@orders_agents
def reload_keys(agents: tuple[str, ...], dry_run: bool, ask: Ask) -> None:
    """Make agents read a new key that `pancakes keys join` has put in place of the old one.

    An agent looks for a new key every minute by itself. New links use the new key, and old links are replaced one by
    one.

    \b
    Example:
        pancakes agent reload-keys agent1
    """
    rows = [{"agent": name, "new_key": found} for name, found in ask_each(ask, ReloadKeys(dry_run), *agents)]
    done = {"done": DRY_RUN if dry_run else "reloaded"}
    ask.printer.table([{**row, **done} for row in rows], ("agent", "new_key", "done"))


@agent.command()
@click.argument("path", metavar="CONFIG", type=click.Path(dir_okay=False))
@click.option("--user", "of_person", is_flag=True, help="Print a unit for your own services (systemctl --user).")
@format_option
@click.option(
    "--run-as", "user", metavar="USER", help="The user of this machine that runs the agent.  [default: pancakes]"
)
def unit(path: str, of_person: bool, user: str | None, printer: Printer) -> None:
    """Print a unit with which systemd runs the agent of CONFIG, waits until it is ready, and restarts it if it hangs.

    A system service runs as its own user, with its own state, log and runtime directories. It may open only the
    devices that the drivers of CONFIG need. See docs/system-service.md.

    \b
    Example:
        pancakes agent unit /etc/pancakes/agent1.toml | sudo tee /etc/systemd/system/pancakes-agent1.service
        pancakes agent unit agent1.toml --user > ~/.config/systemd/user/pancakes-agent1.service
    """
    from pancakes.config import load
    from pancakes.tools.cli.systemd_unit import USER, facts_of, unit_of, user_unit_of
    from pancakes.util.plugins import Plugins

    if of_person and user is not None:
        raise click.UsageError("--run-as is for a system service: a --user service runs as you")
    plugins = Plugins()
    config = load(path, (), plugins, must_load=True)
    if of_person:
        text = user_unit_of(facts_of(config, plugins), os.getcwd(), os.environ)
    else:
        runs_as = USER if user is None else user
        text = unit_of(facts_of(config, plugins, runs_as), runs_as)
    printer.emit([{"agent": config.agent.name, "fleet": config.agent.fleet, "unit": text}], text)


def _sections(found: dict[str, Any], is_own: Callable[[str], bool]) -> dict[str, Any]:
    """Return all about one agent, for people; `is_own` tells the links of this command, which are left out."""
    mesh = found["mesh"]
    tasks = found["tasks"]
    running = sum(task["state"] == "running" for task in tasks)
    return {
        found["agent"]: {
            "role": found["role"],
            "fleet": found["fleet"],
            "addresses": found["listen"],
            "insecure": found["insecure"],
            "ready": found["ready"],
            **_halted(found["halt"]),
            "clock": _clock(found),
            "battery": found["battery_level"],
            **_reserve(found.get("reserve")),
            **({"not allocated": found["unplaced"]} if found.get("unplaced") else {}),
            "load": found["load"],
            "devices": found["devices"],
            "channels": found["channels"],
            "neighbours": found["neighbours"],
            **_few(mesh["few"]),
            "asleep": [peer["name"] for peer in mesh["asleep"]],
            "tasks": f"{running} of {len(tasks)} run (pancakes task list {found['agent']})",
            "dead letters": found["dead_letters"],
            "packets for agents that were away": found["undelivered"],
        },
        "process": {**(found["process"] or {}), **_disk(found)},
        "ways": mesh["ways"],
        "services": [
            {key: row[key] for key in ("service", "type", "state", "tasks", "reason")} for row in found["services"]
        ],
        "links": [_link(peer) for peer in mesh["peers"] if not is_own(peer["name"])],
    }


def _reserve(reserve: dict[str, Any] | None) -> dict[str, str]:
    """Return how long a robot can go on before it must go to a dock, and what is wrong with docks or battery."""
    if reserve is None:
        return {}
    dock = f", then {reserve['way_m']:.1f} m to {reserve['dock'].partition('/')[0]}" if reserve["dock"] else ""
    trouble = {"charging": reserve["trouble"]} if reserve["trouble"] else {}
    return {"reserve": f"{reserve['seconds']:.0f} s{dock}", **trouble}


def _halted(halt: dict[str, Any] | None) -> dict[str, str]:
    """Return who halted an agent, and why."""
    if halt is None:
        return {}
    reason = f": {halt['reason']}" if halt["reason"] else ""
    return {"halted by": f"{halt['by'].partition('/')[0]}{reason} (pancakes halt --end)"}


def _few(few: dict[str, int] | None) -> dict[str, str]:
    """Return how many links an agent keeps, if it does not keep one to each agent."""
    return {"keeps links to": f"{few['links']} of {few['known']} known agents"} if few is not None else {}


def _clock(found: dict[str, Any]) -> str:
    state = ", held until Begin" if found["held"] else ""
    day = f"{utc_text(found['utc_s'])} UTC" if found["utc_s"] is not None else "no time of day"
    return f"{found['mission_s']:.3f} s of the mission, at speed {found['speed']:g}{state}; {day}"


def _disk(found: dict[str, Any]) -> dict[str, str]:
    disk, hours = found.get("disk"), ((found["process"] or {}).get("uptime_s") or 0.0) / 3600.0
    if disk is None or not hours:
        return {}
    syncs, written_mb = disk["syncs"] / hours, disk["written_bytes"] / 1e6 / hours
    return {"disk, an hour": f"{syncs:.0f} fsyncs, {written_mb:.1f} MB written"}


def _link(peer: dict[str, Any]) -> dict[str, Any]:
    rtt_s, clock = peer["rtt_s"], peer["clock"] or {}

    def ms(key: str) -> float | None:
        return None if (value_s := clock.get(key)) is None else 1e3 * value_s

    return {
        "link to": peer["name"],
        "role": peer["role"],
        "address": ", ".join(peer["addresses"]) or peer["remote"],
        "reach": peer["reach"],
        "encrypted": peer["encrypted"],
        "cost": peer["cost"],
        "certificate": peer["certificate"],
        "rtt_ms": None if rtt_s is None else 1e3 * rtt_s,
        "clock ± ms": ms("bound_s"),
        "clock gains ppm": None if not clock else 1e6 * clock["drift"],
        "mission ahead ms": ms("mission_ahead_s"),
        "day ahead ms": ms("day_ahead_s"),
        "packets out": peer["packets_out"],
        "packets in": peer["packets_in"],
        "kB out": peer["bytes_out"] / 1e3,
        "kB in": peer["bytes_in"] / 1e3,
        "waiting": peer["waiting"],
        "dropped": peer["dropped"],
    }
