"""Open a page: the only entry point for the rest of the program."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pancakes.errors import needing_extra
from pancakes.tools.web.exposure import Exposure
from pancakes.tools.web.feed import Shown

if TYPE_CHECKING:
    from pancakes.tools.web.page_server import PageServer


def open_page(shown: Shown, port: int | None, exposure: Exposure | None = None) -> PageServer:
    """Serve a page until it is closed.

    Args:
        shown: what the page shows.
        port: the port; None: the default port, or a free one if that is taken.
        exposure: how it is served beyond the loopback interface; None: only on that interface.

    Raises:
        PancakesError: the port is taken, there is no such address, the certificate cannot be used, or the library is
            missing.
    """
    with needing_extra("the page cannot be served"):
        from pancakes.tools.web.page_server import PageServer
    server = PageServer(shown, exposure)
    server.start(port)
    return server
