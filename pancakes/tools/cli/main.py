"""`pancakes`: speaks to running agents, and runs demos."""

from __future__ import annotations

import os
import sys

import click

from pancakes.tools.cli.lazy import Later, LazyGroup
from pancakes.tools.cli.program import PROGRAM, VARIABLE
from pancakes.tools.cli.version import version_option

COMMANDS = {
    "agent": Later("pancakes.tools.cli.verbs.agent:agent", "Agents that run."),
    "task": Later("pancakes.tools.cli.verbs.task:task", "Tasks that agents have."),
    "service": Later("pancakes.tools.cli.verbs.service:service", "Services that agents have."),
    "channel": Later("pancakes.tools.cli.verbs.channel:channel", "Channels, and the packets on them."),
    "param": Later("pancakes.tools.cli.verbs.param:param", "Settings of tasks."),
    "fleet": Later("pancakes.tools.cli.verbs.fleet:fleet", "Who belongs to a fleet, and what its members may do."),
    "log": Later("pancakes.tools.cli.verbs.log:log", "What agents say and do."),
    "record": Later("pancakes.tools.cli.verbs.record:record", "Recordings of what agents say."),
    "replay": Later("pancakes.tools.cli.verbs.replay:replay", "Feed a recording into a fleet."),
    "rerun": Later("pancakes.tools.cli.verbs.rerun:rerun", "Run a recorded task through its present code."),
    "why": Later("pancakes.tools.cli.verbs.why:why", "What led to the commands of a recording's actuators."),
    "view": Later("pancakes.tools.cli.verbs.view:view", "A page that shows what a fleet does."),
    "report": Later("pancakes.tools.cli.verbs.report:report", "A recording as a page, and as pictures for a paper."),
    "top": Later("pancakes.tools.cli.verbs.top:top", "Watch agents and tasks: rates, lateness, load."),
    "what-if": Later("pancakes.tools.cli.verbs.what_if:what_if", "What a change would do, before it is done."),
    "launch": Later("pancakes.tools.cli.verbs.launch:launch", "Run a fleet from its files."),
    "deploy": Later("pancakes.tools.cli.verbs.deploy:deploy", "Bring a fleet to its hosts, and keep it running there."),
    "down": Later("pancakes.tools.cli.verbs.down:down", "End agents in order."),
    "demo": Later("pancakes.tools.cli.verbs.demo:demo", "Run a whole mission, and judge it."),
    "new": Later("pancakes.tools.cli.verbs.new:new", "Begin a task, driver, service, cost or plug-in of one's own."),
    "config": Later("pancakes.tools.cli.verbs.config:config", "Check and show configuration files."),
    "plugin": Later("pancakes.tools.cli.verbs.plugin:plugin", "What is installed for agents to use."),
    "doctor": Later(
        "pancakes.tools.cli.verbs.doctor:doctor", "Look for what is wrong on this machine and with its agents."
    ),
    "completion": Later("pancakes.tools.cli.verbs.completion:completion", "Completion of names in the shell."),
}


@click.group(cls=LazyGroup, later=COMMANDS)
@version_option("pancakes")
def pancakes() -> None:
    """Robots and sensor nodes that work as one.

    It finds the agents of this machine by itself, others with --at HOST:PORT, and the rest of the fleet through any
    one of them. To run an agent: pancakes-agent.

    Exit codes: 0 ok, 1 refused, 2 usage, 3 unreachable, 4 bad configuration; 130 interrupted, 141 where the
    reader of the output ends early (| head).
    """


def main() -> None:
    """The console script."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell (>&-)
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - it stays open to the end
    if VARIABLE in os.environ:
        from pancakes.tools.cli.verbs.completion import answer_shell

        answer_shell(pancakes)
    pancakes(prog_name=PROGRAM)


if __name__ == "__main__":
    from pancakes.tools.cli import quiet_interrupt  # noqa: F401 - a SIGINT ends it quietly

    main()
