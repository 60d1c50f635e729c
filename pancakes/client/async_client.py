"""Talk to running agents from asyncio: `AsyncClient` and `AsyncSubscriber`, the twins of `Client` and `Subscriber`.

A `Client` waits in a thread pool, and its results are handed to the event loop, which never blocks. Only programs that
use it import asyncio, because the import takes longer than a short command.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Coroutine, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Any, Final, Generic, Protocol, TypeVar, overload

from pancakes.client.client import MOST_WAITING, MOVE_S, Client, limit, say_in_log
from pancakes.client.mesh_client import Replies, Survey, Where
from pancakes.client.rows import AgentRow, EventRow, HeardPacket, TaskRow
from pancakes.client.session import CLOSED, LOOK_S
from pancakes.client.subscriptions import Subscriber
from pancakes.control import Reply
from pancakes.durable.ledger import Ledger
from pancakes.errors import PancakesError, describe
from pancakes.packet import Packet

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


Body = TypeVar("Body")

MOST_CALLS: Final = 32
"""So many calls wait for their answers at a time; others wait until one of them has its own."""


class AsyncClient:
    """What `Client` is, for one event loop, which it never blocks; its methods have the same names and arguments.

        async with AsyncClient() as client:
            for task in await client.tasks():
                print(task, task.state, task.rate_hz)

    A `Client` waits in threads of this one, which hand over what came to the event loop. A call that is cancelled is
    forgotten, and what it asked for may be done all the same.

    Args:
        at: see `Client`, as all others.
        timeout_s: see there.
        say: see there; it is called in the event loop.
    """

    def __init__(
        self,
        at: Where | str | Sequence[str] = (),
        timeout_s: float = 3.0,
        say: Callable[[str], None] = say_in_log,
    ) -> None:
        self.timeout_s = timeout_s
        self._at = at
        self._say = say
        self._pool = ThreadPoolExecutor(MOST_CALLS, thread_name_prefix="pancakes-asyncio")
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
        """See `Client.close`."""
        self._closed = True
        if self._opened is not None:
            # Not in one of the threads that may all wait for answers, and now end.
            await asyncio.to_thread(self._opened.close)
        self._pool.shutdown(wait=False)

    # What is there ---------------------------------------------------------------------------------------------

    async def agents(self, *agents: str, timeout_s: float | None = None) -> list[AgentRow]:
        """See `Client.agents`."""
        return await self._call(Client.agents, *agents, timeout_s=timeout_s)

    async def tasks(self, *agents: str, timeout_s: float | None = None) -> list[TaskRow]:
        """See `Client.tasks`."""
        return await self._call(Client.tasks, *agents, timeout_s=timeout_s)

    async def settings(self, task: str | TaskRow, *, timeout_s: float | None = None) -> dict[str, Any]:
        """See `Client.settings`."""
        return await self._call(Client.settings, task, timeout_s=timeout_s)

    # What is heard ---------------------------------------------------------------------------------------------

    @overload
    def subscribe(
        self,
        channel: str,
        *types: str,
        callback: Callable[[HeardPacket[Any]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> AsyncSubscriber[HeardPacket[Any]]: ...

    @overload
    def subscribe(
        self,
        channel: str,
        *types: type[Body],
        callback: Callable[[HeardPacket[Body]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> AsyncSubscriber[HeardPacket[Body]]: ...

    def subscribe(
        self,
        channel: str,
        *types: Any,
        callback: Callable[[HeardPacket[Any]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> AsyncSubscriber[HeardPacket[Any]]:
        """See `Client.subscribe`; it begins where it is entered or awaited, and raises there what it has to.

        `callback` and `followed_anew` are called in the event loop; the first may be a coroutine function.
        """
        return self._subscriber(
            Client.subscribe,
            channel,
            *types,
            callback=callback,
            agents=agents,
            foreign=foreign,
            most=most,
            timeout_s=timeout_s,
            followed_anew=handed_over(asyncio.get_running_loop(), followed_anew),
        )

    def events(
        self,
        *agents: str,
        kinds: Collection[str] = (),
        callback: Callable[[EventRow], object] | None = None,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
    ) -> AsyncSubscriber[EventRow]:
        """See `Client.events`, and `subscribe`."""
        return self._subscriber(Client.events, *agents, kinds=kinds, callback=callback, most=most, timeout_s=timeout_s)

    # What is done ----------------------------------------------------------------------------------------------

    async def publish(self, channel: str, body: Any, *, to: str = "", timeout_s: float | None = None) -> None:
        """See `Client.publish`."""
        await self._call(Client.publish, channel, body, to=to, timeout_s=timeout_s)

    async def send(self, packet: Packet, *, timeout_s: float | None = None) -> None:
        """See `Client.send`."""
        await self._call(Client.send, packet, timeout_s=timeout_s)

    async def settle(self, *, timeout_s: float | None = None) -> None:
        """See `Client.settle`."""
        await self._call(Client.settle, timeout_s=timeout_s)

    async def configure(
        self,
        task: str | TaskRow,
        settings: Mapping[str, Any],
        *,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """See `Client.configure`."""
        return await self._call(Client.configure, task, settings, dry_run=dry_run, timeout_s=timeout_s)

    async def migrate(
        self,
        task: str | TaskRow,
        to: str = "",
        *,
        then: str = "",
        cost: str | dict[str, float] = "tasks",
        dry_run: bool = False,
        timeout_s: float = MOVE_S,
    ) -> Ledger:
        """See `Client.migrate`."""
        return await self._call(Client.migrate, task, to, then=then, cost=cost, dry_run=dry_run, timeout_s=timeout_s)

    # Control packets -------------------------------------------------------------------------------------------

    async def request(self, agent: str, body: Any, timeout_s: float | None = None) -> Reply:
        """See `Client.request`."""
        return await self._call(Client.request, agent, body, timeout_s)

    async def survey(self, *agents: str, timeout_s: float | None = None) -> Survey:
        """See `Client.survey`."""
        return await self._call(Client.survey, *agents, timeout_s=timeout_s)

    async def ask_each(self, body: Any, *agents: str, timeout_s: float | None = None) -> Replies:
        """See `Client.ask_each`."""
        return await self._call(Client.ask_each, body, *agents, timeout_s=timeout_s)

    # Which agents are meant ------------------------------------------------------------------------------------

    async def is_there(self, agent: str, fleet: str = "") -> bool:
        """See `Client.is_there`."""
        return await self._call(Client.is_there, agent, fleet)

    async def is_connected(self, agent: str, fleet: str = "") -> bool:
        """See `Client.is_connected`."""
        return await self._call(Client.is_connected, agent, fleet)

    async def is_own(self, name: str) -> bool:
        """See `Client.is_own`."""
        return await self._call(Client.is_own, name)

    async def waiting(self, agent: str) -> int:
        """See `Client.waiting`."""
        return await self._call(Client.waiting, agent)

    async def narrow(self, fleet: str) -> None:
        """See `Client.narrow`."""
        await self._call(Client.narrow, fleet)

    async def now(self) -> float:
        """See `Client.now`."""
        return await self._call(Client.now)

    async def wait(self, condition: Callable[[], bool | Awaitable[bool]], timeout_s: float | None = None) -> bool:
        """See `Client.wait`; the condition is looked at in the event loop, and may be a coroutine function."""
        loop = asyncio.get_running_loop()
        limit_s = limit(timeout_s)
        until_s = loop.time() + (self.timeout_s if limit_s is None else limit_s)
        while True:
            holds = condition()
            if holds if isinstance(holds, bool) else await holds:
                return True
            left_s = until_s - loop.time()
            if left_s <= 0.0:
                return False
            await asyncio.sleep(min(left_s, LOOK_S))

    # Within ----------------------------------------------------------------------------------------------------

    def _subscriber(
        self,
        subscribe: Callable[..., Any],
        *arguments: Any,
        callback: Callable[[Any], object] | None,
        timeout_s: float | None,
        **others: Any,
    ) -> AsyncSubscriber[Any]:
        begin = partial(self._call, subscribe, *arguments, timeout_s=timeout_s, **others)
        return AsyncSubscriber(self._in_thread, begin, timeout_s, callback)

    async def _call(self, method: Callable[..., Result], *arguments: Any, **others: Any) -> Result:
        """Returns what a method of the `Client` does, in another thread."""
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
                self._opened = await self._in_thread(Client, self._at, self.timeout_s, handed_over(loop, self._say))
        return self._opened


def handed_over(loop: asyncio.AbstractEventLoop, function: Callable[[str], None]) -> Callable[[str], None]:
    """Returns a function for other threads that has another one called in the event loop."""

    def hand_over(text: str) -> None:
        with suppress(RuntimeError):  # the event loop has ended
            loop.call_soon_threadsafe(function, text)

    return hand_over
