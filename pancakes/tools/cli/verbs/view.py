"""`pancakes view`: show a fleet live on a web page."""

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
    help="The page's port on this machine. [default: 7480, or a free port if that is taken]",
)
"""The option `--port` of every verb that shows a page."""


@click.command()
@click.option(
    "--control", is_flag=True, help="Let the page migrate, stop and start tasks and change settings, not only look."
)
@click.option("--foxglove", is_flag=True, help="Serve the fleet's packets to Foxglove instead of a page.")
@port_option
@click.option("--open", "open_", is_flag=True, help="Also open the page in the browser.")
@asks_agents
def view(control: bool, foxglove: bool, port: int | None, open_: bool, ask: Ask) -> None:
    """Show a fleet on a page in the browser, until Ctrl-C.

    The page shows the arena with its robots (or the mesh, if there are no poses), the agents with their tasks, the
    events, and a timeline of the last ten minutes. It is served only on this machine's loopback interface. To open it
    on another machine: ssh -L 7480:127.0.0.1:7480 HOST. The printed address has a token, without which the page shows
    nothing. With --control, anyone who has the token may change what the agents do.

    With --foxglove it serves the packets of all channels, in the topics and schemas of a recording, at an address for
    Foxglove: "Open connection", "Foxglove WebSocket". This address has no token: every program of this machine, and
    every page in its browser, can read the packets. The default port is 8765.

    \b
    Example:
        pancakes view
        pancakes view --control --at 127.0.0.1:7401
        pancakes view --foxglove
    """
    if foxglove:
        if control or open_:
            raise click.UsageError("--foxglove cannot control and opens no browser: leave out --control and --open")
        from pancakes.tools.cli.foxglove_view import show_in_foxglove

        show_in_foxglove(port, ask)
        return
    from pancakes.tools.web.feed import Feed
    from pancakes.tools.web.page import Shown, open_page
    from pancakes.tools.web.watch import Watch, fleet_among

    ended = event_at(signal.SIGINT, signal.SIGTERM)
    with ask.client() as client:
        fleet = fleet_among(client.describe().agents, ask.where.fleet)
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
    """Print the address of the page."""
    printer.emit([{"address": address, "control": control}], f"the page is at {address}")
