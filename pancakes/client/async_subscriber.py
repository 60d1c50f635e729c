"""Rows that come as agents publish, for programs with asyncio."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable, Coroutine, Generator
from contextlib import suppress
from typing import Any, Generic, Protocol, TypeVar

from pancakes.client.subscriber import Subscriber
from pancakes.errors import PancakesError, describe

Row = TypeVar("Row")
Result = TypeVar("Result")


class InThread(Protocol):
    """Has another thread call a function, and waits for its result without blocking the event loop."""

    def __call__(self, function: Callable[..., Result], *arguments: Any) -> Coroutine[Any, Any, Result]:
        """See the class."""
        ...


class AsyncSubscriber(Generic[Row]):
    """What `Subscriber` is, for one event loop. It begins where it is entered, or awaited:

        async with client.subscribe("agent1/system", Battery) as batteries:
            async for heard in batteries:
                print(heard.source, heard.body.level)

    Args:
        in_thread: see `InThread`.
        begin: makes the subscriber, in another thread.
        timeout_s: how long `next` and the loop wait for a row; None: without end.
        callback: takes each row, in the event loop, one after the other; what it returns is awaited where it can be.
    """

    def __init__(
        self,
        in_thread: InThread,
        begin: Callable[[], Coroutine[Any, Any, Subscriber[Row]]],
        timeout_s: float | None,
        callback: Callable[[Row], object] | None,
    ) -> None:
        self._in_thread = in_thread
        self._begin = begin
        self._timeout_s = timeout_s
        self._callback = callback
        self._begun: Subscriber[Row] | None = None
        self._calling: asyncio.Task[None] | None = None
        self._news = asyncio.Event()
        self._on_its_way = False  # whether the event loop will hear of news

    def __await__(self) -> Generator[Any, None, AsyncSubscriber[Row]]:
        return self.__aenter__().__await__()

    async def __aenter__(self) -> AsyncSubscriber[Row]:
        if self._begun is None:
            loop = asyncio.get_running_loop()
            self._begun = await self._begin()
            self._begun.tell(lambda: self._hand_over(loop))
            if self._callback is not None:
                self._calling = asyncio.create_task(self._call(self._callback))
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncIterator[Row]:
        return self

    async def __anext__(self) -> Row:
        row = await self._wait(self._timeout_s)
        if row is None:
            raise StopAsyncIteration
        return row

    async def next(self, timeout_s: float | None = None) -> Row:
        """Waits for the next row; see `Subscriber.next`."""
        row = await self._wait(self._timeout_s if timeout_s is None else timeout_s)
        if row is None:
            raise PancakesError(f"{self.name} is closed: subscribe again")
        return row

    async def take(self, wait_s: float = 0.0) -> Row | None:
        """Returns the next row; None where none came in time, or it is closed; see `Subscriber.take`."""
        return await self._take(wait_s)

    async def during(self, for_s: float) -> AsyncIterator[Row]:
        """Yields the rows that come within a time from now, and ends then."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + for_s
        while (left_s := until_s - loop.time()) > 0.0:
            row = await self._take(left_s)
            if row is None:
                return
            yield row

    @property
    def name(self) -> str:
        """What it listens to, for sentences: `agent1/system`."""
        return self._subscriber.name

    @property
    def failure(self) -> str:
        """Why no rows come any more, as a sentence; empty while they may."""
        return self._subscriber.failure

    @property
    def missed(self) -> int:
        """How many packets fell out because this program was too slow for them."""
        return self._subscriber.missed

    @property
    def closed(self) -> bool:
        """Whether it has ended, so that no row comes any more."""
        return self._subscriber.closed

    def agents(self) -> list[str]:
        """Returns the names of all agents that it listens to, those too that are away."""
        return self._subscriber.agents()

    def away(self) -> list[str]:
        """Returns the names of the agents that are away; they are listened to again when they come back."""
        return self._subscriber.away()

    async def close(self) -> None:
        """Ends it. What waits is forgotten; what its function returned and is still awaited is cancelled."""
        if self._begun is not None:
            await self._in_thread(self._begun.close)
        if self._calling is not None and self._calling is not asyncio.current_task():
            self._calling.cancel()
            with suppress(asyncio.CancelledError):
                await self._calling

    # In the event loop -----------------------------------------------------------------------------------------

    @property
    def _subscriber(self) -> Subscriber[Row]:
        if self._begun is None:
            raise PancakesError("the subscriber has not begun: enter it with `async with`, or await it")
        return self._begun

    async def _wait(self, limit_s: float | None) -> Row | None:
        """Returns the next row; None where it is closed."""
        row = await self._take(limit_s)
        if row is None and not self.closed:
            raise self._subscriber.nothing_came(limit_s or 0.0)
        return row

    async def _take(self, wait_s: float | None) -> Row | None:
        """Returns the next row. Nothing is awaited once it is taken, so that none is lost where this is cancelled."""
        subscriber = self._subscriber
        loop = asyncio.get_running_loop()
        until_s = None if wait_s is None else loop.time() + wait_s
        await asyncio.sleep(0)  # other tasks go on where rows come faster than they are read
        while True:
            self._news.clear()
            row = subscriber.take()
            if row is not None or subscriber.closed or (until_s is not None and loop.time() >= until_s):
                return row
            with suppress(TimeoutError):
                async with asyncio.timeout_at(until_s):
                    await self._news.wait()

    async def _call(self, callback: Callable[[Row], object]) -> None:
        subscriber = self._subscriber
        while (row := await self._take(None)) is not None:
            try:
                result = callback(row)
                if inspect.isawaitable(result):
                    await result
            except Exception as error:
                reason = f"the function that takes what comes failed, and gets no more: {describe(error)}"
                await self._in_thread(subscriber.fail, reason)
                return

    def _wake(self) -> None:
        self._on_its_way = False
        self._news.set()

    # In other threads ------------------------------------------------------------------------------------------

    def _hand_over(self, loop: asyncio.AbstractEventLoop) -> None:
        if not self._on_its_way:
            self._on_its_way = True
            with suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(self._wake)
