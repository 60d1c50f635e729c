"""`pancakes zenoh router`: a Zenoh router, where upstream's `zenohd` is not at hand."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence

import click

from pancakes.errors import PancakesError
from pancakes.tools.cli.options import Duration
from pancakes.tools.cli.output import show_text

DEFAULT_LISTEN = "tcp/[::]:7447"


@click.group()
def zenoh() -> None:
    """Zenoh routers, which join agents of several networks."""


@zenoh.command()
@click.option("--listen", multiple=True, metavar="ADDRESS", help=f"Where agents reach it; {DEFAULT_LISTEN} if none.")
@click.option(
    "--connect", multiple=True, metavar="ADDRESS", help="Another router that it joins, such as tcp/HOST:7447."
)
@click.option("--config", "file", default="", metavar="FILE", help="A configuration file of Zenoh's, with TLS, say.")
@click.option(
    "--silent",
    "silent_s",
    default="2s",
    show_default=True,
    type=Duration(0.5, 60.0),
    metavar="TIME",
    help="Agents take it for gone once it is silent for so long.",
)
def router(listen: Sequence[str], connect: Sequence[str], file: str, silent_s: float) -> None:
    """Run a Zenoh router until SIGINT or SIGTERM."""
    import zenoh as upstream  # and with it 20 MiB, for which --help has no use

    from pancakes_zenoh.router_session import first_words, session_config

    config = session_config("router", connect, file, "", silent_s)
    at = list(listen) or ([] if file else [DEFAULT_LISTEN])
    # Before there are threads, which would not inherit it.
    ends = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)
    try:
        if at:
            config.insert_json5("listen/endpoints", json.dumps(at))
        session = upstream.open(config)
    except upstream.ZError as error:
        raise PancakesError(
            f"the router cannot listen at {', '.join(at) or f'what {file} says'}: {first_words(error)}"
        ) from None
    show_text(f"The router {session.info.zid()} listens at {', '.join(at) or f'what {file} says'}.")
    signal.sigwait(ends)
    session.close()
