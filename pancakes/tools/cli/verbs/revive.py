"""`pancakes task revive`: a task whose agent is gone for good runs again on another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
import msgspec

from pancakes.control import Reschedule, Revive
from pancakes.errors import ControlRefused, PancakesError
from pancakes.tools.cli.asking import accepted, meant
from pancakes.tools.cli.name_types import AGENT_NAME, TaskName, a_task
from pancakes.tools.cli.options import Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN

if TYPE_CHECKING:
    from pancakes.runtime.config.tables import TaskConfig

RUNS = ("running", "starting", "restarting", "stuck")


@click.command()
@a_task
@click.option("--config", "path", metavar="FILE", required=True, help="The configuration of the agent that is lost.")
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Put VALUE in place of what FILE has. Repeatable."
)
@click.option(
    "--birthplace", metavar="AGENT", type=AGENT_NAME, default="", help="Its birthplace. [default: FILE's agent]"
)
@click.option("--force", is_flag=True, help="Do it. Without, it is only said what it would mean.")
@dry_run_option
@orders_agents
def revive(
    name: TaskName, path: str, sets: tuple[str, ...], birthplace: str, force: bool, dry_run: bool, ask: Ask
) -> None:
    """Run a task on AGENT whose own agent is gone for good: anew, as the configuration of that agent says.

    Its state is lost. It runs under an epoch above all that can be known of it, so actuators obey it, and packets for
    it come to AGENT. Where the lost agent comes back, its copy stands still once the two are linked. Without --force
    nothing is done but to say what it would mean, and the exit code is 1.

    A task whose hand-off is in doubt has its state still: see `pancakes task adopt`.

    \b
    Example:
        pancakes task revive agent2/ScanTarget --config agent1.toml
        pancakes task revive agent2/ScanTarget --config agent1.toml --force
    """
    from pancakes.runtime.config import load
    from pancakes.runtime.plugins import Plugins

    config = load(path, sets, Plugins())
    task = config.tasks.get(name.task)
    if task is None:
        raise PancakesError(f"{config.path} has no [task.{name.task}]: it has {', '.join(config.tasks) or 'no task'}")
    with ask.client() as client:
        name = meant(client, name)
        body = _asked(task, f"{birthplace or config.agent.name}/{name.task}", name.service, force, dry_run)
        for agent in client.survey().agents:
            for row in agent["tasks"]:
                if (row["task"], row["service"]) == (name.task, body.service) and row["state"] in RUNS:
                    raise ControlRefused(f"{name.task} is {row['state']} on {agent['agent']}: it is not lost")
        reply = accepted(client, name.agent, body)
        if task.rate_hz is not None and not dry_run:
            accepted(client, name.agent, Reschedule(f"{body.service}/{name.task}", task.rate_hz))
    done = {"task_id": reply.result["task_id"], "done": DRY_RUN if dry_run else "revived", "number": reply.number}
    ask.show([{"agent": name.agent, **done}], ("agent", *done))


def _asked(task: TaskConfig, task_id: str, service: str, force: bool, dry_run: bool) -> Revive:
    return Revive(
        task_id,
        task.type,
        service or task.service,
        dict(task.settings),
        msgspec.to_builtins(task.restart),
        task.durability,
        msgspec.to_builtins(task.migrate) if task.migrate is not None else None,
        msgspec.to_builtins(task.guard_rule) if task.guard_rule is not None else None,
        force or dry_run,
        dry_run,
    )
