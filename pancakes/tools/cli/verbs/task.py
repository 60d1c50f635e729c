"""`pancakes task ...`: list, show, start, stop, create and remove the tasks of agents.

Verbs that migrate tasks are in `task_migration`, those for lost, guarded and disputed tasks in `task_recovery`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.control import Create, Describe, Reload, Remove, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefusedError, NoAnswerError, UnreachableError
from pancakes.supervision.restart import tries
from pancakes.tools.cli.agent_requests import (
    confirm,
    request,
    request_result,
    resolve_fleet,
    resolve_service,
    show_done,
    survey,
    survey_with,
    yes_option,
)
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import (
    Ask,
    Duration,
    FiniteRange,
    TakesNumbers,
    TaskName,
    a_task,
    agents,
    asks_agents,
    dry_run_option,
    keep_state_option,
    orders_agents,
)
from pancakes.tools.cli.output import DRY_RUN, Rows, show_text
from pancakes.tools.cli.verbs.task_arguments import Changes, SettingChange, set_option, tasks_beside, timers, types
from pancakes.tools.cli.verbs.task_migration import forget_peer, migrate, migrations
from pancakes.tools.cli.verbs.task_recovery import fence, guards, recover
from pancakes.tools.short_state import MOST_BYTES, shortened
from pancakes.util.text import did_you_mean

if TYPE_CHECKING:
    from pancakes.client import Client


@click.command()
@a_task
@click.option(
    "--type",
    "type_",
    metavar="TYPE",
    required=True,
    shell_complete=types,
    help="The task's class, such as encirclement.ScanTarget.",
)
@set_option("Give the task this setting. Repeatable.")
@click.option("--rate", "rate_hz", metavar="HZ", type=FiniteRange(min=0.0), help="Ticks per second; 0: no ticks yet.")
@click.option("--guard", type=click.Choice(["3", "5"]), help="How many agents guard the task.")
@click.option("--lease", "lease_s", metavar="TIME", type=Duration(), help="The duration of its leases.")
@click.option(
    "--key",
    "keys",
    metavar="KEY=VALUE",
    type=SettingChange(),
    multiple=True,
    help="Any other key of [task.TASK] in a configuration, such as durability=each. Repeatable.",
)
@dry_run_option
@orders_agents
def create(
    name: TaskName,
    type_: str,
    sets: Changes,
    rate_hz: float | None,
    guard: str | None,
    lease_s: float | None,
    keys: Changes,
    dry_run: bool,
    ask: Ask,
) -> None:
    """Create a task that no configuration file names, and wait until it runs.

    The service `client` runs it, or another one if you name it: AGENT/SERVICE/TASK. The new task behaves like one that
    a file names: it starts with its agent, and can be migrated and guarded. `pancakes task remove` ends it for good.
    `pancakes config show AGENT` prints it as TOML to keep.

    A value of --set or --key is read as TOML (5, true, [1, 2]) if possible, otherwise as a string.

    \b
    Example:
        pancakes task create agent1/ScanTarget --type encirclement.ScanTarget --set radius_m=0.8 --rate 2
        pancakes task create agent1/Watch --type patrol.Watch --guard 3 --lease 2 --key restart.policy=on-failure
    """
    from pancakes.tools.cli.verbs.param_file import changes_of

    table = changes_of({}, dict(keys))
    for option, key, value in (("--guard", "copies", int(guard) if guard else None), ("--lease", "lease_s", lease_s)):
        if value is None:
            continue
        rule = table.setdefault("guard", {})
        if not isinstance(rule, dict) or key in rule:
            raise click.UsageError(f"{option} and --key guard.{key} set the same key: give only one of them")
        rule[key] = value
    with ask.client() as client:
        name = resolve_fleet(client, name)
        body = Create(name.target, type_, changes_of({}, dict(sets)), rate_hz, table, dry_run)
        reply = request(client, name.agent, body)
    if reply.result["silent"]:
        silent = ", ".join(reply.result["silent"])
        show_text(f"could not ask whether these agents know the task: {silent}", err=True)
    if table.get("guard") and not dry_run:
        text = f"only {name.agent} guards the task until other agents agree: see pancakes task guards"
        show_text(text, err=True)
    done = DRY_RUN if dry_run else "created"
    row: dict[str, Any] = {"agent": name.agent, **reply.result, "done": done, "number": reply.number}
    ask.printer.table([row], ("agent", "task_id", "epoch", "done", "number"))


@click.command()
@a_task
@yes_option
@dry_run_option
@orders_agents
def remove(name: TaskName, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop a task that no configuration file names, and delete it with its state.

    A later task of this name begins from scratch. A task that a file names is refused, because it would start again
    with its agent.

    \b
    Example:
        pancakes task remove agent1/ScanTarget
        pancakes task remove agent1/ScanTarget --yes
    """
    with ask.client() as client:
        name = resolve_service(client, name)
        if not (force or dry_run):
            request(client, name.agent, Remove(name.target, True))
        confirm(f"this ends {name} for good, and its state is lost", force, dry_run)
        show_done(ask, client, name, "removed", Remove(name.target, dry_run))


COLUMNS = ("agent", "service", "task", "type", "state", "rate_hz")
LONG = (*COLUMNS, "incarnation", "ticks", "missed", "lateness_max_s", "dropped", "reason")
READS = ("channel", "types", "queue", "limit", "waiting", "dropped")
STATES = ("stopped", "starting", "running", "stopping", "stuck", "restarting", "failed")
"""The values of `pancakes.supervision.lifecycle.WORDS`. Importing that module would slow each command."""


SECTIONS: Final = {
    "Everyday": {
        "list": "List tasks, and whether they run.",
        "info": "Show all about a task: timers, queues, settings, state.",
        "start": "Start a stopped task.",
        "stop": "Stop a task.",
        "restart": "Stop a task and start it again.",
        "reload": "Have running tasks go on in the class that is on disk now.",
        "rate": "Change the rate of a task.",
        "create": "Create a task that no configuration file names.",
        "remove": "Stop such a task, and delete it.",
    },
    "Migration": {
        "migrate": "Migrate a task to the neighbour with the lowest bid.",
        "migrations": "List migrations: who was asked, who has the task.",
        "guards": "List guarded tasks, and where their copies are.",
        "fence": "Show which tasks have commanded an actuator.",
    },
    "Recovery": {
        "recover": "Say what happened to a task in trouble, and set it right.",
        "forget-peer": "Drop tasks whose hand-off from an agent is in doubt.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def task() -> None:
    """Show, control and migrate tasks; a device is a task too, with the device's name."""


task.add_command(create)
task.add_command(remove)
task.add_command(migrate)
task.add_command(migrations)
task.add_command(forget_peer)
task.add_command(fence)
task.add_command(guards)
task.add_command(recover)


@task.command("list")
@agents
@click.option("--service", metavar="NAME", default="", help="Only tasks of the service of this name.")
@click.option("--type", "type_", metavar="PATTERN", default="*", help="Only tasks of these types: sim.*")
@click.option("--state", type=click.Choice(STATES), help="Only tasks in this state.")
@click.option("--long", "-l", is_flag=True, help="Also show starts, missed ticks, lost packets, and why they stopped.")
@asks_agents
def list_(agents: tuple[str, ...], service: str, type_: str, state: str | None, long: bool, ask: Ask) -> None:
    """List the tasks of all agents, or only of those named.

    An agent that does not answer in time is named on standard error; the exit code is 3 if none answers.

    \b
    Example:
        pancakes task list
        pancakes task list agent1 --format json
        pancakes task list --service device --state running
    """
    rows = [
        row
        for found in survey(ask, *agents)
        for row in found["tasks"]
        if service in ("", row["service"]) and state in (None, row["state"]) and fnmatchcase(row["type"], type_)
    ]
    columns = LONG if long else COLUMNS
    for_programs = [{key: row[key] for key in (*columns, "rest")} for row in rows]
    for_people = [{**row, "state": row["rest"] or row["state"]} for row in rows]  # `rest` is the more specific word
    ask.printer.emit(for_programs, Rows(for_people, columns))


@task.command()
@a_task
@click.option("--state", "with_state", is_flag=True, help="Also show the present state of the task.")
@asks_agents
def info(name: TaskName, with_state: bool, ask: Ask) -> None:
    """Show all about a task: timers, subscriptions, settings, restart policy, and the last failure with its traceback.

    For a guarded task that AGENT owns it also shows the permit, the guardians, and the age of the checkpoint that each
    guardian holds.

    --state adds the task's state, taken between two of its turns, and the nodes of its behaviour tree if it has one.
    The table truncates long values.

    JSON is the unchanged answer of the agent, with the JSON Schema of the settings. With --state it also has the
    whole state as "kept_state", its mission time as "kept_state_s", and as "kept_state_reason" why the state is
    missing.

    \b
    Example:
        pancakes task info agent1/ScanTarget
        pancakes task info agent1/ScanTarget --state
        pancakes task info agent1/pose --format json
    """
    with ask.client() as client:
        name = resolve_service(client, name)
        found = request_result(client, name.agent, Describe(name.target))
        kept = _kept(client, name, ask.timeout_s) if with_state else {}
    sections = {**_sections(str(name), found), **(_state_section(kept) if kept else {})}
    ask.printer.emit([{**found, **kept}], sections)


@task.command()
@a_task
@set_option("Start it with this setting. Repeatable.")
@dry_run_option
@orders_agents
def start(name: TaskName, sets: Changes, dry_run: bool, ask: Ask) -> None:
    """Start a stopped task, and wait until it runs.

    A value of --set is read as TOML (5, true, [1, 2]) if possible, otherwise as a string.

    \b
    Example:
        pancakes task start agent1/GoHome
        pancakes task start agent1/ScanTarget --set radius_m=0.8
    """
    from pancakes.tools.cli.verbs.param_file import changes_of

    settings = changes_of({}, dict(sets)) or None
    _order(ask, name, "started", lambda target: Start(target, settings, dry_run))


@task.command()
@a_task
@click.option(
    "--then",
    metavar="TASK",
    default="",
    shell_complete=tasks_beside,
    help="Start this task in its place, once it has let its actuators go.",
)
@dry_run_option
@orders_agents
def stop(name: TaskName, then: str, dry_run: bool, ask: Ask) -> None:
    """Stop a task after the message that it is handling, and wait until it has stopped.

    It stays stopped, even if its agent is restarted.

    \b
    Example:
        pancakes task stop agent1/ScanTarget
        pancakes task stop agent1/Charge --then ScanTarget
    """
    _order(ask, name, "stopped", lambda target: Stop(target, dry_run=dry_run, then=then))


@task.command()
@a_task
@keep_state_option("Keep the task's state and settings, or begin from scratch as its configuration says.")
@yes_option
@dry_run_option
@orders_agents
def restart(name: TaskName, keep_state: bool, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop a task, start it, and wait until it runs.

    With --drop-state it asks first; if this is not a terminal, --yes is required.

    \b
    Example:
        pancakes task restart agent1/ScanTarget
        pancakes task restart agent1/ScanTarget --drop-state --yes
    """
    with ask.client() as client:
        name = resolve_service(client, name)
        if not (keep_state or force or dry_run):
            request(client, name.agent, Restart(name.target, keep_state, dry_run=True))
            confirm(f"{name} would begin from scratch, as its configuration says: its state is lost", force)
        show_done(ask, client, name, "restarted", Restart(name.target, keep_state, dry_run))


@task.command()
@click.argument("type_", metavar="TYPE", shell_complete=types)
@agents
@dry_run_option
@orders_agents
def reload(type_: str, agents: tuple[str, ...], dry_run: bool, ask: Ask) -> None:
    """Import a task type again as it is on disk, and have its running tasks go on in the new class.

    Each task keeps its settings, its state and its identity. Other types of the same distribution are reloaded too. If
    the import fails, or the state of one task does not fit its new class, all tasks of that agent go on as they are.

    Without AGENT it asks the agents that have a task of this type. With AGENT it also makes a type known that was
    installed while the agent ran.

    \b
    Example:
        pancakes task reload loadwatch.LoadWatch --dry-run
        pancakes task reload loadwatch.LoadWatch
        pancakes task reload loadwatch.LoadWatch agent1 agent2
    """
    with ask.client() as client:
        if not agents:
            found = survey_with(client)
            agents = tuple(sorted({row["agent"] for one in found for row in one["tasks"] if row["type"] == type_}))
            if not agents:
                hint = did_you_mean(type_, sorted({row["type"] for one in found for row in one["tasks"]}))
                raise ControlRefusedError(f"no agent that answers has a task of the type {type_!r}{hint}")
        answers = client.request_all(Reload(type_, dry_run), *agents)
    rows: list[dict[str, Any]] = []
    for name, reply in answers.replies:
        if not reply.ok:
            continue
        about = {"agent": name, "before": reply.result["before"], "version": reply.result["version"]}
        done = {"done": DRY_RUN if dry_run else "reloaded", "number": reply.number}
        none = {"service": "", "task": "", "type": type_, "state": ""}  # it is known there now
        rows += [{**about, **row, **done} for row in reply.result["tasks"] or [none]]
        if reply.result["stays"]:
            show_text(f"as before, until {name} is restarted: {', '.join(reply.result['stays'])}", err=True)
    if rows:
        ask.printer.table(rows, ("agent", "service", "task", "type", "before", "version", "done", "number"))
    refused = [f"{name} refused: {reply.reason}" for name, reply in answers.replies if not reply.ok]
    if refused:
        raise ControlRefusedError("\n".join([*answers.silent, *refused]))
    if answers.silent:
        raise UnreachableError("\n".join(answers.silent))


@task.command(cls=TakesNumbers)
@a_task
@click.argument("rate_hz", metavar="HZ", type=FiniteRange(min=0.0))
@click.option(
    "--timer",
    metavar="METHOD",
    default="",
    shell_complete=timers,
    help="The timer, if the task has several.",
)
@dry_run_option
@orders_agents
def rate(name: TaskName, rate_hz: float, timer: str, dry_run: bool, ask: Ask) -> None:
    """Change the rate of a time-driven task to HZ ticks per second, from its next tick on; 0 stops the ticks.

    \b
    Example:
        pancakes task rate agent1/ir 2
        pancakes task rate agent1/Discovery 0.2 --timer announce
    """
    _order(ask, name, "rate changed", lambda target: Reschedule(target, rate_hz, timer, dry_run))


def _order(ask: Ask, name: TaskName, done: str, body: Callable[[str], Start | Stop | Reschedule]) -> None:
    """Send a control packet, made by `body` from the task's target, and print that it was done."""
    with ask.client() as client:
        name = resolve_service(client, name)
        show_done(ask, client, name, done, body(name.target))


def _kept(client: Client, name: TaskName, timeout_s: float) -> dict[str, Any]:
    """Return the state of a task and its mission time, or the reason why the state is not known."""
    try:
        reply = client.request(name.agent, Describe(name.target, state=True))
    except NoAnswerError:  # its service has just answered, so only the task itself is busy
        busy = f"{name} did not report its state within {timeout_s:g} s: it may be busy. Try again or raise --timeout"
        return {"kept_state": None, "kept_state_s": None, "kept_state_reason": busy}
    if not reply.ok:
        return {"kept_state": None, "kept_state_s": None, "kept_state_reason": reply.reason}
    return {"kept_state": reply.result["state"], "kept_state_s": reply.result["mission_s"], "kept_state_reason": ""}


def _state_section(kept: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of a task, for people."""
    if kept["kept_state"] is None:
        return {"task state": kept["kept_state_reason"]}
    short = shortened(kept["kept_state"], most_bytes=4 * MOST_BYTES)
    cut = " (truncated; --format json has all of it)" if short.cut else ""
    title = f"task state, at {kept['kept_state_s']:.3f} s{cut}"
    tree = [
        {"node": f"{'. ' * row.depth}{row.name}", "kind": row.kind, "status": row.status, "message": row.message}
        for row in short.tree
    ]
    empty = "empty: this task keeps no state" if not tree else ""
    return {"behaviour tree": tree, title: dict(short.rows) or empty}


def _readings(readings: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return how many readings or commands of a device came and were missed, for people."""
    if readings is None:
        return {}
    why = f"; the last one: {readings['why']}" if readings["why"] else ""
    return {"readings or commands": f"{readings['came']}, and {readings['missed']} missed{why}"}


def _sections(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return all about one task, for people."""
    fence, failure = found["fence"], found["failure"]
    return {
        name: {
            "type": found["type"],
            **({"in a file": "no: it was created"} if found["created"] else {}),
            "state": found["rest"] or found["state"],
            "reason": found["reason"],
            "tries": tries(found),
            "starts": found["incarnation"],
            "requires": found["requires"],
            "on disk": found["durability"],
            "guarded": _guarding(found["guard"]),
            **_permit(found.get("guarding")),
            "restarts": _policy(found["restart"]),
            "epoch": None if fence is None else f"{fence['epoch']} of {fence['task_id']}",
            "packets dropped": found["dropped"],
            **_readings(found.get("readings")),
        },
        "filters": [
            {
                **{key: row[key] for key in ("filter", "type", "passed", "changed", "held", "doing", "why")},
                "for_s": round(row["for_s"], 1),
            }
            for row in found.get("filters", ())
        ],
        "guardians": [dict(row) for row in found.get("guarding", {}).get("guardians", ())],
        "timers": [
            {
                **{key: timer[key] for key in ("timer", "rate_hz", "ticks", "missed")},
                "lateness_mean_ms": 1e3 * timer["lateness_mean_s"],
                "lateness_max_ms": 1e3 * timer["lateness_max_s"],
            }
            for timer in found["timers"]
        ],
        "reads": [
            {
                **{key: row[key] for key in READS},
                "types": "all" if row["types"] is None else row["types"],
            }
            for row in found["reads"]
        ],
        "settings": found["settings"],
        f"last failure, at {failure['t_s']:.3f} s" if failure else "": failure["traceback"] if failure else "",
    }


def _guarding(guard: Mapping[str, Any] | None) -> str:
    return f"by {guard['copies']}, lease {guard['lease_s']:g} s" if guard is not None else "no"


def _permit(guarding: Mapping[str, Any] | None) -> dict[str, str]:
    """Return the permit of a guarded task that this agent owns, and the checkpoint that its guardians hold."""
    if guarding is None:
        return {}
    permit_s, age_s = guarding["permit_s"], guarding["age_s"]
    age = f", {age_s:.1f} s old" if age_s is not None else ""
    why = ", because the disk is a copy" if guarding["copied"] else ""
    return {
        "permit": f"{permit_s:.1f} s" if permit_s else f"none: the task is paused{why}",
        "guardians that answer": f"{guarding['answering']} of {len(guarding['guardians'])}; {guarding['guard']} wanted",
        "checkpoint they hold": f"{guarding['epoch']}/{guarding['checkpoint']}{age}",
    }


def _policy(restart: Mapping[str, Any]) -> str:
    """A restart policy in a line."""
    if restart["policy"] == "no":
        return "no"
    again = f", then every {restart['again_s']:g} s" if restart["again_s"] else ""
    return (
        f"{restart['policy']}, at most {restart['at_most']} times in {restart['within_s']:g} s,"
        f" after {restart['pause_s']:g} s to {restart['pause_max_s']:g} s{again}"
    )
