"""`pancakes service ...`: the services of agents."""

from __future__ import annotations

import click

from pancakes.cli.asking import order
from pancakes.cli.client import Client
from pancakes.cli.errors import sentences
from pancakes.cli.names import ServiceName, a_service
from pancakes.cli.options import Duration, orders_agents
from pancakes.cli.output import show
from pancakes.control import Restart, Start, Stop

DONE = ("agent", "service", "done")


@click.group()
def service() -> None:
    """Services that agents have."""


@service.command()
@a_service
@orders_agents
@sentences
def start(name: ServiceName, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Start a service that stands still, and wait until it and its tasks run.

    \b
    Example:
        pancakes service start agent1/client
    """
    with Client(at, timeout) as client:
        order(client, name.agent, Start(name.target))
    show([{**name._asdict(), "done": "started"}], DONE, format_)


@service.command()
@a_service
@click.option(
    "--for", "for_s", metavar="TIME", type=Duration(), help="It starts again by itself after this mission time: 30s."
)
@orders_agents
@sentences
def stop(name: ServiceName, for_s: float | None, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Stop a service and all of its tasks, and wait for that.

    The Network Service of another agent can be stopped for a time only: nobody could start it again.

    \b
    Example:
        pancakes service stop agent1/client
        pancakes service stop agent1/network --for 30s
    """
    with Client(at, timeout) as client:
        order(client, name.agent, Stop(name.target, for_s))
    show([{**name._asdict(), "done": "stopped", "for_s": for_s}], (*DONE, "for_s"), format_)


@service.command()
@a_service
@orders_agents
@sentences
def restart(name: ServiceName, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Stop a service and all of its tasks, start it, and wait until it runs. The tasks keep their state.

    \b
    Example:
        pancakes service restart agent1/device
    """
    with Client(at, timeout) as client:
        order(client, name.agent, Restart(name.target))
    show([{**name._asdict(), "done": "restarted"}], DONE, format_)
