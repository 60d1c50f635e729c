"""`pancakes view`: a page that shows what a fleet does."""

from __future__ import annotations

import signal
import time

import click

from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.output import Printer
from pancakes.tools.cli.streaming import event_at

port_option = click.option(
    "--port",
    type=click.IntRange(1, 65535),
    help="The page's port on this machine. [default: 7480, or a free one if that is taken]",
)
"""The option `--port` of every verb that shows a page."""


@click.command()
@click.option(
    "--control", is_flag=True, help="Let the page move, stop and start tasks and change settings; else it looks."
)
@click.option("--foxglove", is_flag=True, help="Serve the fleet's packets to Foxglove in place of the page.")
@port_option
@click.option("--open", "open_", is_flag=True, help="Open the page in the browser as well.")
@asks_agents
def view(control: bool, foxglove: bool, port: int | None, open_: bool, ask: Ask) -> None:
    """Show a fleet on a page in the browser, until Ctrl-C.

    It shows the arena with its robots (or the mesh, if there are no poses), the agents with their tasks, what
    happens, and the last ten minutes on a timeline. The page is served on this machine's loopback interface only. From
    another machine: ssh -L 7480:127.0.0.1:7480 HOST. The address that is printed has a token, without
    which the page shows nothing; with --control a user who has it may change what the agents do.

    With --foxglove it serves the packets of all channels, in the topics and schemas of a recording, at an address that
    Foxglove opens: "Open connection", "Foxglove WebSocket". That has no token: every program of this machine can read
    it, and every page in its browser. Its usual port is 8765.

    \b
    Example:
        pancakes view
        pancakes view --control --at 127.0.0.1:7401
        pancakes view --foxglove
    """
    if foxglove:
        if control or open_:
            raise click.UsageError("--foxglove only shows, and opens no browser: leave --control and --open out")
        from pancakes.tools.cli.foxglove_view import show_in_foxglove

        show_in_foxglove(port, ask)
        return
    from pancakes.tools.web.feed import Feed
    from pancakes.tools.web.page import Shown, open_page
    from pancakes.tools.web.watch import Watch, fleet_among

    ended = event_at(signal.SIGINT, signal.SIGTERM)
    with ask.client() as client:
        fleet = fleet_among(client.survey().agents, ask.where.fleet)
    began_s = time.monotonic()
    feed = Feed(lambda: time.monotonic() - began_s)
    watch = Watch(feed, ask.where.addresses, fleet, ask.timeout_s)
    server = open_page(Shown(feed, watch.explain, watch.order, watch.order if control else None), port)
    try:
        watch.start()
        tell_address(server.address, control, ask.printer)
        if open_:
            click.launch(server.address)
        ended.wait()
    finally:
        server.close()
        watch.close()


def tell_address(address: str, control: bool, printer: Printer) -> None:
    """Say where the page is."""
    printer.emit([{"address": address, "control": control}], f"the page is at {address}")
