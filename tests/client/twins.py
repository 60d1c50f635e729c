"""`Client` and `AsyncClient` behind one face, so that one suite of tests holds for both."""

from __future__ import annotations

import asyncio
import inspect
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Final

from pancakes.client import AsyncClient, AsyncSubscriber, Client

PATIENCE_S: Final = 30.0

Connect = Callable[..., AbstractContextManager[Any]]
"""Makes a client, of the arguments of `Client`."""


class LoopThread:
    """An event loop that runs in a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()

    def call(self, function: Callable[..., Any], *arguments: Any, **others: Any) -> Any:
        """Call a function in the event loop; returns its result once it is there."""
        if threading.current_thread() is self._thread:
            return function(*arguments, **others)

        async def called() -> Any:
            result = function(*arguments, **others)
            return await result if inspect.isawaitable(result) else result

        result = asyncio.run_coroutine_threadsafe(called(), self._loop).result(PATIENCE_S)
        return SubscriberTwin(self, result) if isinstance(result, AsyncSubscriber) else result

    def close(self) -> None:
        """End it."""
        self.call(self._loop.shutdown_default_executor)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE_S)
        self._loop.close()


class ClientTwin:
    """An `AsyncClient` with blocking methods."""

    def __init__(self, loop: LoopThread, client: AsyncClient) -> None:
        self._loop = loop
        self._client = client

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._client, name)
        return lambda *arguments, **others: self._loop.call(method, *arguments, **others)


class SubscriberTwin:
    """An `AsyncSubscriber` with blocking methods."""

    def __init__(self, loop: LoopThread, subscriber: AsyncSubscriber[Any]) -> None:
        self._loop = loop
        self._subscriber = subscriber

    def __enter__(self) -> SubscriberTwin:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        async def following() -> tuple[Any, ...]:
            async for row in self._subscriber:
                return (row,)
            return ()

        for row in self._loop.call(following):
            return row
        raise StopIteration

    def during(self, for_s: float) -> Iterator[Any]:
        async def gathered() -> list[Any]:
            return [row async for row in self._subscriber.during(for_s)]

        yield from self._loop.call(gathered)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._subscriber, name)
        return (lambda *given, **others: self._loop.call(found, *given, **others)) if callable(found) else found


@contextmanager
def in_an_event_loop(*arguments: Any, **others: Any) -> Iterator[Any]:
    """Make an `AsyncClient`, and blocks where it is awaited."""
    loop = LoopThread()
    try:
        client = loop.call(AsyncClient, *arguments, **others)
        loop.call(client.__aenter__)
        try:
            yield ClientTwin(loop, client)
        finally:
            loop.call(client.__aexit__, None, None, None)
    finally:
        loop.close()


TWINS: Final[dict[str, Connect]] = {"Client": Client, "AsyncClient": in_an_event_loop}
