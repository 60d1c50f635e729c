"""Await in a task: `async def` handlers, ticks and hooks, for what talks to a web API, a camera service or a database.

What is awaited goes on between turns, on an asyncio event loop of the task's own. Meanwhile the task answers control
messages: it can be stopped, frozen and described. Its packets, ticks and calls wait, as they do behind any handler.

The loop runs in the task's own thread, and not at all while the task is frozen: no code of its author runs between the
snapshot and the end of a migration. If the migration succeeds, and when the task is stopped, the coroutine is
cancelled. If the migration fails, the coroutine goes on where it was.

In virtual time the clock of the loop is the virtual one: `asyncio.sleep(2)` takes two seconds of it. A coroutine that
waits for the outside, as for a socket or a thread, goes on at the next moment of virtual time at which the loop wakes.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol

from pancakes.packet import THREAD, Packet

CANCEL_S: Final = 0.5
"""How long a coroutine that is cancelled may take to end, in host seconds."""
STOP_S: Final = 1.0
"""How long `async def on_stop` may take, in host seconds; then it is cancelled."""


class Awaited:
    """What an actor awaits between its turns.

    Args:
        task: the coroutine, as a task of the actor's loop.
        packet: the packet that it handles; None: a tick, a call or a hook.
        then: what follows in the actor once it has ended well.
        is_stop: whether it is `on_stop`, with which the actor ends.

    Attributes:
        behind: what else has come of the same packet, and waits for it; each with the coroutine that it begins.
        failed: what is called in the actor if it fails.
    """

    def __init__(
        self,
        task: asyncio.Task[Any],
        packet: Packet | None,
        then: Callable[[], None] | None = None,
        is_stop: bool = False,
    ) -> None:
        self.task = task
        self.packet = packet
        self.then = then
        self.is_stop = is_stop
        self.behind: deque[tuple[Callable[[], Any], Coroutine[Any, Any, Any] | None]] = deque()
        self.failed: list[Callable[[], Any]] = []

    def drop_behind(self) -> None:
        """Begin nothing of what waits behind it: it has failed, or is cancelled."""
        while self.behind:
            _, coroutine = self.behind.popleft()
            if coroutine is not None:
                coroutine.close()


class Awaiting(Protocol):
    """What a loop needs of the actor that it belongs to."""

    awaited: Awaited | None
    in_hand: Packet | None

    def now(self) -> float:
        """Return the mission time in seconds."""

    def lost(self, what: str, error: BaseException | None) -> None:
        """Log what has gone wrong in its loop that nothing waits for."""

    def local_time(self, packet: Any) -> Any:
        """Return when a packet was published, on the clock of the actor's agent."""


class _AtOnce(list[Callable[[], None]]):
    """What a coroutine puts off to the end of its turn is done at once: it has no turn, and may run for long."""

    def append(self, function: Callable[[], None]) -> None:
        function()


class ActorLoop:
    """The event loop of one actor, which runs in the actor's thread between turns.

    Args:
        actor: the actor.
        loop: the loop; None: a new one.
    """

    def __init__(self, actor: Awaiting, loop: asyncio.AbstractEventLoop | None = None) -> None:
        self._actor = actor
        self.loop = loop or asyncio.new_event_loop()
        # By itself asyncio would write to the terminal: of a task of its author's whose error nobody has looked at.
        self.loop.set_exception_handler(lambda loop, context: actor.lost(context["message"], context.get("exception")))

    def run(self) -> None:
        """Run until `interrupt`, or until what is awaited has ended. In the actor's thread."""
        self._as_the_actor(self.loop.run_forever)

    def settle(self) -> None:
        """In virtual time: run what can run at the present moment. In the actor's turn."""

    def interrupt(self) -> None:
        """Let `run` return soon: the actor has something in its mailbox. Any thread."""
        with contextlib.suppress(RuntimeError):  # it was closed just now
            self.loop.call_soon_threadsafe(self.loop.stop)

    def cancel(self, task: asyncio.Task[Any]) -> bool:
        """Cancel a coroutine, and let it end for at most `CANCEL_S`; return whether it has. In the actor's turn."""
        task.cancel()
        self._complete(asyncio.wait({task}, timeout=CANCEL_S))
        return task.done()

    def close(self) -> None:
        """Cancel what is left, and close the loop. In the actor's thread, when the actor has ended."""
        self._complete(self._end())
        self.loop.close()

    async def _end(self) -> None:
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        if left:
            await asyncio.wait(left, timeout=CANCEL_S)
        await self.loop.shutdown_asyncgens()
        # A transport that was closed closes its socket in the next round.
        await asyncio.sleep(0)

    def _complete(self, coroutine: Coroutine[Any, Any, Any]) -> None:
        ended = self.loop.create_task(coroutine)
        while not ended.done():
            with contextlib.suppress(RuntimeError):  # an interrupt from before its turn
                self._as_the_actor(lambda: self.loop.run_until_complete(ended))

    def _as_the_actor(self, run: Callable[[], Any]) -> None:
        actor, turn = self._actor, THREAD.turn
        before, deferred, in_hand = turn.reader, turn.deferred, actor.in_hand
        if actor.awaited is not None:
            actor.in_hand = actor.awaited.packet
        turn.reader, turn.deferred = actor, _AtOnce()
        try:
            run()
        except (SystemExit, KeyboardInterrupt):
            pass  # the task has it as its error, which is that of the actor
        finally:
            turn.reader, turn.deferred, actor.in_hand = before, deferred, in_hand


class _VirtualLoop(asyncio.SelectorEventLoop):
    """A loop on a virtual clock, which is stepped.

    Args:
        now: returns the virtual time, in seconds.
        wake_at: called with the virtual time at which it must be stepped again.
    """

    def __init__(self, now: Callable[[], float], wake_at: Callable[[float], None]) -> None:
        super().__init__()
        self._now = now
        self._wake_at = wake_at
        self._progressed = False

    def time(self) -> float:
        return self._now()

    def call_soon(self, callback: Any, *args: Any, context: Any = None) -> asyncio.Handle:  # type: ignore[override]
        self._progressed = True
        return super().call_soon(callback, *args, context=context)

    def call_at(  # type: ignore[override]
        self, when: float, callback: Any, *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        self._wake_at(when)
        return super().call_at(when, callback, *args, context=context)

    def settle(self) -> None:
        """Run what can run at the present virtual time."""
        self._progressed = True
        while self._progressed:
            self._progressed = False
            super().call_soon(self.stop)
            self.run_forever()


class VirtualActorLoop(ActorLoop):
    """The event loop of one actor in virtual time.

    Args:
        actor: the actor.
        now: returns the virtual host time of its agent, in seconds.
        call_in: called with a delay in seconds of that time, after which `settle` must be called in the actor.
    """

    loop: _VirtualLoop

    def __init__(self, actor: Awaiting, now: Callable[[], float], call_in: Callable[[float], None]) -> None:
        super().__init__(actor, _VirtualLoop(now, lambda when_s: call_in(max(0.0, when_s - now()))))

    def settle(self) -> None:
        self._as_the_actor(self.loop.settle)

    def _complete(self, coroutine: Coroutine[Any, Any, Any]) -> None:
        ended = self.loop.create_task(coroutine)
        self.settle()
        ended.cancel()  # it may wait for a time-out, and virtual time does not pass meanwhile
        self.settle()
