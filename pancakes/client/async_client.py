"""A program with asyncio speaks to running agents: `AsyncClient`, the twin of `Client`."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Any, Final, TypeVar, overload

from pancakes.client.agent_row import AgentRow
from pancakes.client.async_subscriber import AsyncSubscriber
from pancakes.client.event_row import EventRow
from pancakes.client.fleet_client import MOST_WAITING, MOVE_S, Client, limit, say_in_log
from pancakes.client.heard_packet import HeardPacket
from pancakes.client.survey import Replies, Survey
from pancakes.client.task_row import TaskRow
from pancakes.client.waits import CLOSED, LOOK_S
from pancakes.client.where import Where
from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes.mesh.migration.ledger import Ledger
from pancakes.packet import Packet

Body = TypeVar("Body")
Result = TypeVar("Result")

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
