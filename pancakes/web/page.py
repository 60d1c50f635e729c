"""How a page is opened: the rest of the program needs no more than this."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes.packet import Cause
from pancakes.web.feed import Feed

if TYPE_CHECKING:
    from pancakes.web.server import PageServer


@dataclass(frozen=True)
class Shown:
    """What a page shows.

    Attributes:
        feed: the fleet.
        explain: returns why an agent's actuator was commanded; as `Explaining.explain`, from any thread.
        order: asks an agent for something within a time limit; None: the page may only look.
        title: what the page is headed with; empty: the fleet's name.
    """

    feed: Feed
    explain: Callable[[str, str, float | None, Cause | None, int], dict[str, Any] | None]
    order: Callable[[str, Any, float], Future[Reply]] | None = None
    title: str = ""


def open_page(shown: Shown, port: int | None) -> PageServer:
    """Serves a page on the loopback interface until it is closed.

    Args:
        shown: what it shows.
        port: the port; None: the usual one, or a free one where that is taken.

    Raises:
        PancakesError: the port is taken, or the library is missing.
    """
    try:
        from pancakes.web.server import PageServer
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "websockets":
            raise
        raise PancakesError(
            "the page needs the library websockets, which is not installed: pip install 'pancakes-agents[web]'"
        ) from None
    server = PageServer(shown)
    server.start(port)
    return server
