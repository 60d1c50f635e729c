"""One connection to the page's server, before it is known whether it becomes a WebSocket.

The library behind it speaks WebSocket, whose requests are all GET: of another method some of its versions take no
notice, and a request with a body they leave without an answer. So that is seen to here.
"""

from __future__ import annotations

from http import HTTPStatus
from typing import Any, Final

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Response

from pancakes.tools.web.http import refused

METHODS: Final = "GET"
LONGEST_METHOD: Final = 20
"""No method is longer; the library refuses what begins with more letters."""


class PageConnection(ServerConnection):
    """Answers requests of other methods than GET, with the sentence that there is no other."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._begun: bytes | None = b""
        self._refused = False

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        if self._refused:
            return  # what it still sends of its request; it is closed like all that open no page in time
        if self._begun is not None:
            data = self._begun + data
            method, space, _ = data.partition(b" ")
            if not space and len(data) < LONGEST_METHOD and b"\n" not in data:
                self._begun = data
                return
            self._begun = None
            if space and method.isalpha() and method != METHODS.encode():
                self._refuse(method.decode())
                return
        super().data_received(data)

    def _refuse(self, method: str) -> None:
        self._refused = True
        response: Response = refused(HTTPStatus.METHOD_NOT_ALLOWED, f"{method} changes nothing here: there is only GET")
        response.headers["Allow"] = METHODS
        self.transport.write(response.serialize())
        self.transport.write_eof()
