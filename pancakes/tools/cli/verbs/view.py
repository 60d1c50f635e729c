"""`pancakes view`: show a fleet live on a web page."""

from __future__ import annotations

import secrets
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from pancakes.errors import PancakesError, UnreachableError
from pancakes.tools.cli.options import Ask, asks_agents
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.password_prompt import ask_password
from pancakes.tools.cli.streaming import event_at

if TYPE_CHECKING:
    from pancakes.tools.web.exposure import Exposure

port_option = click.option(
    "--port",
    type=click.IntRange(1, 65535),
    help="The page's port on this machine. [default: 7480, or a free port if that is taken]",
)
"""The option `--port` of every verb that shows a page."""
_FILE: Final = click.Path(dir_okay=False, path_type=Path)


@click.command()
@click.option(
    "--control", is_flag=True, help="Let the page migrate, stop and start tasks and change settings, not only look."
)
@click.option("--foxglove", is_flag=True, help="Serve the fleet's packets to Foxglove instead of a page.")
@port_option
@click.option("--open", "open_", is_flag=True, help="Also open the page in the browser.")
@click.option(
    "--host",
    metavar="ADDRESS",
    default="",
    help="Serve the page to other machines too, at this address of this machine (0.0.0.0: at all); needs a password.",
)
@click.option(
    "--password-file", type=_FILE, help="File with the page's password in its first line, readable only by you."
)
@click.option("--generate-password", is_flag=True, help="Make a password for the page, and print it once.")
@click.option("--certificate", type=_FILE, help="Certificate with which the page is served over HTTPS, as PEM.")
@click.option("--key", type=_FILE, help="Private key of the certificate. [default: in the same file]")
@click.option(
    "--name",
    "names",
    metavar="NAME",
    multiple=True,
    help="Further host name under which browsers may open the page. Repeatable. [default: this machine's host name]",
)
@asks_agents
def view(
    control: bool,
    foxglove: bool,
    port: int | None,
    open_: bool,
    host: str,
    password_file: Path | None,
    generate_password: bool,
    certificate: Path | None,
    key: Path | None,
    names: tuple[str, ...],
    ask: Ask,
) -> None:
    """Show a fleet on a page in the browser, until Ctrl-C.

    The page shows the arena with its robots (or the mesh, if there are no poses), the agents with their tasks, the
    events, plots of any number, and a timeline of the last ten minutes. If no agent runs yet, it waits. It is served
    only on this machine's loopback interface. To open it on another machine: ssh -L 7480:127.0.0.1:7480 HOST. The
    printed address has a token, without which the page shows nothing. With --control, anyone who has the token may
    change what the agents do.

    With --host it is served to other machines, and needs a password: from --password-file, from --generate-password, or
    asked for at the terminal. Anyone who knows the password may do what you may do: look, and with --control change
    what the agents do. Without --certificate, the password travels unencrypted.

    With --foxglove it serves the packets of all channels, in the topics and schemas of a recording, at an address for
    Foxglove: "Open connection", "Foxglove WebSocket". This address has no token: every program of this machine, and
    every page in its browser, can read the packets. The default port is 8765.

    \b
    Example:
        pancakes view
        pancakes view --control --at 127.0.0.1:7401
        pancakes view --host 0.0.0.0 --password-file page.password --certificate robot1.pem --key robot1.key
        pancakes view --foxglove
    """
    wanted = _Wanted(host, password_file, generate_password, certificate, key, names)
    if foxglove:
        if control or open_ or wanted != _Wanted():
            raise click.UsageError("--foxglove takes only --port, and which agents: leave out the options of the page")
        from pancakes.tools.cli.foxglove_view import show_in_foxglove

        show_in_foxglove(port, ask)
        return
    from pancakes.tools.web.feed import Feed
    from pancakes.tools.web.page import Shown, open_page
    from pancakes.tools.web.watch import Watch

    exposure = wanted.exposure()
    ended = event_at(signal.SIGINT, signal.SIGTERM)
    fleet = _fleet_now(ask)
    began_s = time.monotonic()
    feed = Feed(lambda: time.monotonic() - began_s)
    watch = Watch(feed, ask.where.addresses, fleet, ask.timeout_s)
    server = open_page(Shown(feed, watch.explain, watch.order, watch.order if control else None), port, exposure)
    try:
        watch.start()
        if exposure is None:
            tell_address(server.address, control, ask.printer)
        else:
            _tell_exposed(server.address, control, exposure, generate_password, ask.printer)
        if open_:
            click.launch(server.address)
        ended.wait()
    finally:
        server.close()
        watch.close()


def tell_address(address: str, control: bool, printer: Printer) -> None:
    """Print the address of the page."""
    printer.emit([{"address": address, "control": control}], f"the page is at {address}")


def _tell_exposed(address: str, control: bool, exposure: Exposure, generated: bool, printer: Printer) -> None:
    row = {"address": address, "control": control}
    text = f"the page is at {address}"
    if generated:
        row["password"] = exposure.password
        text = f"the password of the page is {exposure.password}\n{text}"
    if exposure.certificate is None:
        show_text(
            "warning: the password and all that the page shows travel unencrypted: use --certificate, or only a network"
            " that you trust",
            err=True,
        )
    printer.emit([row], text)


def _fleet_now(ask: Ask) -> str:
    """Return the fleet to show; if no agent answers, the one that was asked for, which may be empty.

    Raises:
        PancakesError: there are several fleets, or this client may not ask.
    """
    from pancakes.tools.web.watch import fleet_among

    try:
        with ask.client() as client:
            return fleet_among(client.describe().agents, ask.where.fleet)
    except UnreachableError as error:
        show_text(f"the page waits for agents: {error}", err=True)
        return ask.where.fleet


@dataclass(frozen=True)
class _Wanted:
    """The options that serve the page to other machines."""

    host: str = ""
    password_file: Path | None = None
    generate_password: bool = False
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()

    def exposure(self) -> Exposure | None:
        """Return how the page is served beyond the loopback interface; None: not at all.

        Raises:
            UsageError: options contradict each other.
            PancakesError: there is no password, or it cannot be used.
        """
        from pancakes.tools.web.exposure import Exposure, checked_names, is_loopback

        if not self.host:
            if self != _Wanted():
                raise click.UsageError(
                    "--password-file, --generate-password, --certificate, --key and --name need --host"
                )
            return None
        if self.key is not None and self.certificate is None:
            raise click.UsageError("--key needs --certificate")
        if is_loopback(self.host) and not (self.password_file or self.generate_password or self.certificate):
            raise click.UsageError(
                f"--host {self.host} is the loopback interface: leave --host out, or give the page a password"
            )
        return Exposure(self.host, self._password(), checked_names(self.names), self.certificate, self.key)

    def _password(self) -> str:
        from pancakes.tools.web.exposure import checked_password, password_in

        if self.password_file is not None and self.generate_password:
            raise click.UsageError("--password-file and --generate-password exclude each other")
        if self.password_file is not None:
            return password_in(self.password_file)
        if self.generate_password:
            return secrets.token_urlsafe(12)
        if not sys.stdin.isatty():
            raise PancakesError(
                f"a page at {self.host} needs a password, because other machines reach it: use --password-file or"
                " --generate-password"
            )
        return checked_password(ask_password("Password of the page", again=True))
