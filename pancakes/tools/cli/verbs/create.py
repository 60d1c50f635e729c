"""`pancakes task create|remove`: tasks that no configuration file names."""

from __future__ import annotations

from typing import Any

import click

from pancakes.creation import Create, Remove
from pancakes.tools.cli.asking import accepted, meant, placed, show_done
from pancakes.tools.cli.consent import force_option, must_be_meant
from pancakes.tools.cli.name_types import TaskName, a_task
from pancakes.tools.cli.options import Ask, Duration, FiniteRange, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.tools.cli.verbs.param_names import Changes, SettingChange, set_option
from pancakes.tools.cli.verbs.task_completion import types


@click.command()
@a_task
@click.option(
    "--type",
    "type_",
    metavar="TYPE",
    required=True,
    shell_complete=types,
    help="Its class, such as encirclement.ScanTarget.",
)
@set_option("Give it this setting. Repeatable.")
@click.option("--rate", "rate_hz", metavar="HZ", type=FiniteRange(min=0.0), help="How often it ticks; 0: not yet.")
@click.option("--guard", type=click.Choice(["3", "5"]), help="Have so many agents guard it.")
@click.option("--lease", "lease_s", metavar="TIME", type=Duration(), help="How long its leases are.")
@click.option(
    "--key",
    "keys",
    metavar="KEY=VALUE",
    type=SettingChange(),
    multiple=True,
    help="Any other key that [task.TASK] has in a file: durability=each. Repeatable.",
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
    """Make a task that no configuration file names, and wait until it runs. AGENT/SERVICE/TASK has another service than
    `client` look after it.

    From then on it is like one that a file names: it comes back with its agent, can be moved and guarded, and is ended
    for good by `pancakes task remove`. `pancakes config show AGENT` prints it as TOML to keep.

    A value of --set or --key that reads as TOML is taken as such (5, true, [1, 2]), anything else as a string.

    \b
    Example:
        pancakes task create agent1/ScanTarget --type encirclement.ScanTarget --set radius_m=0.8 --rate 2
        pancakes task create agent1/Watch --type patrol.Watch --guard 3 --lease 2 --key restart.policy=on-failure
    """
    from pancakes.tools.cli.verbs.param_file import changes_of

    table = changes_of({}, dict(keys))
    for option, key, value in (("--guard", "guard", int(guard) if guard else None), ("--lease", "lease_s", lease_s)):
        if value is not None and key in table:
            raise click.UsageError(f"{option} and --key {key} say the same: give one of them")
        if value is not None:
            table[key] = value
    with ask.client() as client:
        name = meant(client, name)
        body = Create(name.target, type_, changes_of({}, dict(sets)), rate_hz, table, dry_run)
        reply = accepted(client, name.agent, body)
    if reply.result["silent"]:
        show_text(f"not asked whether they know it: {', '.join(reply.result['silent'])}", err=True)
    if table.get("guard") and not dry_run:
        text = f"{name.agent} alone guards it until other agents have agreed to: see pancakes task guards"
        show_text(text, err=True)
    done = DRY_RUN if dry_run else "created"
    row: dict[str, Any] = {"agent": name.agent, **reply.result, "done": done, "number": reply.number}
    ask.show([row], ("agent", "task_id", "epoch", "done", "number"))


@click.command()
@a_task
@force_option
@dry_run_option
@orders_agents
def remove(name: TaskName, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop a task that no configuration file names, and forget it: its state is gone.

    A later task of its name begins anew. One that a file names is refused, as it would be back with its agent.

    \b
    Example:
        pancakes task remove agent1/ScanTarget
        pancakes task remove agent1/ScanTarget --force
    """
    with ask.client() as client:
        name = placed(client, name)
        if not (force or dry_run):
            accepted(client, name.agent, Remove(name.target, True))
        must_be_meant(f"{name} ends for good, and its state is lost", force, dry_run)
        show_done(ask, client, name, "removed", Remove(name.target, dry_run))
