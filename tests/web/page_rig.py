"""A page without a browser, and a fake fleet for it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from websockets.sync.client import ClientConnection, connect

from pancakes.control import Describe, Reply
from pancakes.errors import PancakesError
from pancakes.packet import Cause
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.page_server import PageServer

PATIENCE_S = 20.0


class Fleet:
    """A fake fleet that records the questions to it."""

    def __init__(self) -> None:
        self.t = 1.0
        """The present on the timeline."""
        self.feed = Feed(lambda: self.t)
        self.asked: list[tuple[str, Any]] = []
        self.answer: Reply | PancakesError = Reply(None, {"lines": []})
        self.looked: list[tuple[str, Describe]] = []
        self.looks: dict[bool, Reply | PancakesError] = {}
        self.waiting: list[Future[Reply]] | None = None

    def order(self, agent: str, body: Any, timeout_s: float) -> Future[Reply]:
        self.asked.append((agent, body))
        future: Future[Reply] = Future()
        if isinstance(self.answer, Reply):
            future.set_result(self.answer)
        else:
            future.set_exception(self.answer)
        return future

    def look(self, agent: str, body: Describe, timeout_s: float) -> Future[Reply]:
        """Answer by whether the state is asked for; later, where answers are to wait."""
        self.looked.append((agent, body))
        future: Future[Reply] = Future()
        if self.waiting is not None:
            self.waiting.append(future)
            return future
        result = self.looks[body.state]
        if isinstance(result, Reply):
            future.set_result(result)
        else:
            future.set_exception(result)
        return future

    def explain(
        self, agent: str, type_: str, t: float | None, command: Cause | None, step: int
    ) -> dict[str, Any] | None:
        return {"agent": agent, "asked": [type_, t, command, step]}


@contextmanager
def page(server: PageServer, **options: Any) -> Iterator[ClientConnection]:
    """Open what the page opens, and show the token."""
    with stranger(server, **options) as connection:
        assert ask(connection, "hello", token=server.token)["ok"]
        yield connection


def stranger(server: PageServer, **options: Any) -> ClientConnection:
    """Open what the page opens, and say nothing."""
    origin = f"http://127.0.0.1:{server.port}"
    return connect(
        f"ws://127.0.0.1:{server.port}/news", origin=options.pop("origin", origin), compression=None, **options
    )


def ask(connection: ClientConnection, what: str, **fields: Any) -> dict[str, Any]:
    """Ask for something, and return the answer among all the news."""
    connection.send(json.dumps({"id": 7, "ask": what, **fields}))
    return answer_to(connection, 7)


def answer_to(connection: ClientConnection, number: int) -> dict[str, Any]:
    """Return the answer to what was asked under a number, among all the news."""
    while True:
        message: dict[str, Any] = json.loads(connection.recv(PATIENCE_S))
        if message.get("answer") == number:
            return message
