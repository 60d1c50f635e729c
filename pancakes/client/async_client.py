"""Talk to running agents from asyncio: `AsyncClient` and `AsyncSubscriber`.

They do what `Client` and `Subscriber` do. A `Client` waits in a thread pool, and its results are passed to the event
loop, which never blocks. Only programs that use this module import asyncio, whose import takes longer than a short
command.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial, wraps
from types import TracebackType
from typing import Any, Concatenate, Final, Generic, ParamSpec, Protocol, TypeVar

from pancakes.client.client import Client, check_timeout, log_warning
from pancakes.client.session import CLOSED, LOOK_S, Target
from pancakes.client.subscriptions import Subscriber, callback_failed
from pancakes.errors import PancakesError

Row = TypeVar("Row")
Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")


class InThread(Protocol):
    """Call a function in another thread, and await its result."""

    def __call__(self, function: Callable[..., Result], *arguments: Any) -> Coroutine[Any, Any, Result]:
        """See the class."""
        ...


class AsyncSubscriber(Generic[Row]):
    """Read what comes on a channel, in an event loop. It begins when it is entered or awaited:

        async with client.subscribe("agent1/system", Battery) as batteries:
            async for received in batteries:
                print(received.source, received.body.level)

    Args:
        in_thread: see `InThread`.
        begin: makes the subscriber, in another thread.
        timeout_s: how long `next` and the loop wait for a row; None: without end.
        callback: takes each row, in the event loop, one after the other; it may be a coroutine function.
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
        self._wake_pending = False  # whether the event loop will call `_wake`

    def __await__(self) -> Generator[Any, None, AsyncSubscriber[Row]]:
        return self.__aenter__().__await__()

    async def __aenter__(self) -> AsyncSubscriber[Row]:
        if self._begun is None:
            loop = asyncio.get_running_loop()
            self._begun = await self._begin()
            self._begun.on_news(lambda: self._wake_later(loop))
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
        """Wait for the next row; see `Subscriber.next`."""
        row = await self._wait(self._timeout_s if timeout_s is None else timeout_s)
        if row is None:
            raise PancakesError(f"{self.name} is closed: subscribe again")
        return row

    async def take(self, wait_s: float = 0.0) -> Row | None:
        """Return the next row; None if none came in time, or it is closed; see `Subscriber.take`."""
        return await self._take(wait_s)

    async def during(self, for_s: float) -> AsyncIterator[Row]:
        """Yield the rows that come within this time from now."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + for_s
        while (left_s := until_s - loop.time()) > 0.0:
            row = await self._take(left_s)
            if row is None:
                return
            yield row

    @property
    def name(self) -> str:
        """See `Subscriber.name`."""
        return self._subscriber.name

    @property
    def failure(self) -> str:
        """See `Subscriber.failure`."""
        return self._subscriber.failure

    @property
    def missed(self) -> int:
        """See `Subscriber.missed`."""
        return self._subscriber.missed

    @property
    def closed(self) -> bool:
        """See `Subscriber.closed`."""
        return self._subscriber.closed

    def agents(self) -> list[str]:
        """See `Subscriber.agents`."""
        return self._subscriber.agents()

    def away(self) -> list[str]:
        """See `Subscriber.away`."""
        return self._subscriber.away()

    async def close(self) -> None:
        """End it and drop what waits. A callback that is still awaited is cancelled."""
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
        """Return the next row; None if it is closed."""
        row = await self._take(limit_s)
        if row is None and not self.closed:
            raise self._subscriber.nothing_came(limit_s or 0.0)
        return row

    async def _take(self, wait_s: float | None) -> Row | None:
        """Return the next row. Nothing is awaited once it is taken, so none is lost if this is cancelled."""
        subscriber = self._subscriber
        loop = asyncio.get_running_loop()
        until_s = None if wait_s is None else loop.time() + wait_s
        await asyncio.sleep(0)  # so other tasks run even if rows come faster than they are read
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
                await self._in_thread(subscriber.fail, callback_failed(error))
                return

    def _wake(self) -> None:
        self._wake_pending = False
        self._news.set()

    # In other threads ------------------------------------------------------------------------------------------

    def _wake_later(self, loop: asyncio.AbstractEventLoop) -> None:
        if not self._wake_pending:
            self._wake_pending = True
            with suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(self._wake)


MAX_CALLS: Final = 32
"""At most this many calls wait for their answers at a time; further calls wait until one of them is answered."""


def _awaited(
    method: Callable[Concatenate[Client, Arguments], Result],
) -> Callable[Concatenate[AsyncClient, Arguments], Coroutine[Any, Any, Result]]:
    """Derive a coroutine method from a method of `Client`, with its arguments and its docstring."""

    @wraps(method, assigned=("__name__", "__doc__"))
    async def call(self: AsyncClient, *arguments: Arguments.args, **others: Arguments.kwargs) -> Result:
        return await self._call(method, *arguments, **others)

    return call


def _subscribing(
    method: Callable[Concatenate[Client, Arguments], Subscriber[Row]],
) -> Callable[Concatenate[AsyncClient, Arguments], AsyncSubscriber[Row]]:
    """Derive a method that returns an `AsyncSubscriber`; its callbacks are called in the event loop."""

    @wraps(method, assigned=("__name__", "__doc__"))
    def subscribe(self: AsyncClient, *arguments: Any, **others: Any) -> AsyncSubscriber[Row]:
        callback = others.pop("callback", None)
        if "on_resubscribe" in others:
            others["on_resubscribe"] = _in_loop(asyncio.get_running_loop(), others["on_resubscribe"])
        begin = partial(self._call, method, *arguments, **others)
        return AsyncSubscriber(self._in_thread, begin, others.get("timeout_s"), callback)

    return subscribe


def _in_loop(loop: asyncio.AbstractEventLoop, function: Callable[[str], None]) -> Callable[[str], None]:
    """Return a function for other threads that has another one called in the event loop."""

    def call_soon(text: str) -> None:
        with suppress(RuntimeError):  # the event loop has ended
            loop.call_soon_threadsafe(function, text)

    return call_soon


class AsyncClient:
    """Do what `Client` does, in one event loop, which it never blocks. Its methods have the same names and arguments.

        async with AsyncClient() as client:
            for task in await client.tasks():
                print(task, task.state, task.rate_hz)

    A `Client` waits in a pool of threads, which pass the results to the event loop. If a call is cancelled, its answer
    is dropped; the agent may still do what was asked.

    A subscriber begins, and raises its errors, when it is entered or awaited. Callbacks are called in the event loop;
    that of a subscriber may be a coroutine function.

    Args:
        at: see `Client`, as for all others.
        timeout_s: see `Client`.
        say: see `Client`; it is called in the event loop.
        fleet: see `Client`.
    """

    def __init__(
        self,
        at: Target | str | Sequence[str] = (),
        timeout_s: float = 3.0,
        say: Callable[[str], None] = log_warning,
        *,
        fleet: str = "",
    ) -> None:
        self.timeout_s = timeout_s
        self._at = at
        self._fleet = fleet
        self._say = say
        self._pool = ThreadPoolExecutor(MAX_CALLS, thread_name_prefix="pancakes-asyncio")
        self._opening = asyncio.Lock()
        self._opened: Client | None = None
        self._closed = False

    async def __aenter__(self) -> AsyncClient:
        await self._client()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._opened is not None:
            await asyncio.to_thread(self._opened.__exit__, kind, error, traceback)
        await self.close()

    async def close(self) -> None:
        """End all subscribers, and leave all fleets."""
        self._closed = True
        if self._opened is not None:
            # Not in the pool: all of its threads may be waiting for answers.
            await asyncio.to_thread(self._opened.close)
        self._pool.shutdown(wait=False)

    agents = _awaited(Client.agents)
    tasks = _awaited(Client.tasks)
    settings = _awaited(Client.settings)
    subscribe = _subscribing(Client.subscribe)
    events = _subscribing(Client.events)
    publish = _awaited(Client.publish)
    send = _awaited(Client.send)
    settle = _awaited(Client.settle)
    start = _awaited(Client.start)
    stop = _awaited(Client.stop)
    restart = _awaited(Client.restart)
    set_rate = _awaited(Client.set_rate)
    configure = _awaited(Client.configure)
    migrate = _awaited(Client.migrate)
    request = _awaited(Client.request)
    describe = _awaited(Client.describe)
    request_all = _awaited(Client.request_all)
    is_reachable = _awaited(Client.is_reachable)
    is_connected = _awaited(Client.is_connected)

    async def wait(self, condition: Callable[[], bool | Awaitable[bool]], timeout_s: float | None = None) -> bool:
        """Wait until a condition is true; see `Client.wait`.

        Args:
            condition: is called in the event loop; it may be a coroutine function.
            timeout_s: how long at most; None: the time limit of the client.
        """
        loop = asyncio.get_running_loop()
        limit_s = check_timeout(timeout_s)
        until_s = loop.time() + (self.timeout_s if limit_s is None else limit_s)
        while True:
            holds = condition()
            if holds if isinstance(holds, bool) else await holds:
                return True
            left_s = until_s - loop.time()
            if left_s <= 0.0:
                return False
            await asyncio.sleep(min(left_s, LOOK_S))

    async def _call(
        self,
        method: Callable[Concatenate[Client, Arguments], Result],
        *arguments: Arguments.args,
        **others: Arguments.kwargs,
    ) -> Result:
        """Call a method of the `Client`, in another thread."""
        return await self._in_thread(method, await self._client(), *arguments, **others)

    async def _in_thread(self, function: Callable[..., Result], *arguments: Any, **others: Any) -> Result:
        if self._closed:
            raise PancakesError(CLOSED)
        called = partial(function, *arguments, **others)
        return await asyncio.get_running_loop().run_in_executor(self._pool, called)

    async def _client(self) -> Client:
        async with self._opening:
            if self._opened is None:
                loop = asyncio.get_running_loop()
                say = _in_loop(loop, self._say)
                self._opened = await self._in_thread(partial(Client, fleet=self._fleet), self._at, self.timeout_s, say)
        return self._opened
