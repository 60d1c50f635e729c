"""What the client for asyncio promises besides: it blocks no event loop, and loses nothing that is cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextlib import suppress
from itertools import cycle
from typing import Any

import pytest
from client.counting_agents import Count, CountingAgents
from client.twins import PATIENCE_S

from pancakes.client import AsyncClient, ReceivedPacket
from pancakes.control import Describe
from pancakes.errors import NoPacketError, PancakesError

pytestmark = pytest.mark.usefixtures("counting")


def run(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine in an event loop of its own, which says where it was blocked for long."""
    asyncio.run(asyncio.wait_for(coroutine, PATIENCE_S))


def test_others_go_on_while_an_answer_is_waited_for(counting: CountingAgents):
    async def main() -> None:
        async with AsyncClient(timeout_s=PATIENCE_S) as client:
            await client.request("b", Describe())
            with counting.frozen(counting.b):
                waits = asyncio.create_task(client.request("b", Describe()))
                assert {row.agent for row in await client.tasks("a")} == {"a"}
                async with client.subscribe("a/system", Count) as counts:
                    await counts.next()
                assert not waits.done()
            assert (await waits).ok

    run(main())


def test_others_go_on_where_packets_come_faster_than_they_are_read():
    async def main() -> None:
        turns = 0

        async def other() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        async with AsyncClient() as client, client.subscribe("a/flood", Count, max_waiting=1000) as flood:
            while flood.missed == 0:
                await asyncio.sleep(0.01)
            runs = asyncio.create_task(other())
            for number in range(100):
                await flood.next()
                assert turns >= number
            runs.cancel()

    run(main())


def test_what_is_cancelled_while_it_waits_loses_no_packet():
    async def main() -> None:
        async with AsyncClient() as client, client.subscribe("a/system", Count) as counts:
            first = (await counts.next()).body.number
            heard = [first]
            for turns in cycle(range(5)):
                waits = asyncio.create_task(counts.next())
                for _ in range(turns):
                    await asyncio.sleep(0)
                waits.cancel()
                with suppress(asyncio.CancelledError):
                    heard.append((await waits).body.number)
                if len(heard) == 20:
                    break
            assert heard == list(range(first, first + 20))

    run(main())


def test_a_coroutine_function_takes_one_packet_after_the_other():
    async def main() -> None:
        heard: list[int] = []
        enough = asyncio.Event()

        async def take(it: ReceivedPacket[Count]) -> None:
            number = it.body.number
            await asyncio.sleep(0.03)
            heard.append(number)
            if len(heard) == 5:
                enough.set()

        async with AsyncClient() as client:
            async with client.subscribe("a/system", Count, callback=take) as counts:
                await enough.wait()
            assert counts.closed
            assert heard == list(range(heard[0], heard[0] + len(heard)))

    run(main())


def test_a_subscriber_can_be_awaited_and_one_that_has_not_begun_says_so():
    async def main() -> None:
        async with AsyncClient() as client:
            counts = client.subscribe("a/system", Count)
            with pytest.raises(PancakesError, match="the subscriber has not begun"):
                await counts.next()
            await counts
            assert isinstance((await counts.next()).body, Count)
            quiet = await client.subscribe("b/system", Count, timeout_s=0.1)
            with pytest.raises(NoPacketError):
                async for _ in quiet:
                    pass

    run(main())


def test_a_client_that_closes_ends_what_still_waits():
    async def main() -> None:
        client = AsyncClient(timeout_s=PATIENCE_S)
        counts = await client.subscribe("b/system", Count)
        waits = asyncio.create_task(counts.next())
        await asyncio.sleep(0)
        await client.close()
        with pytest.raises(PancakesError, match="b/system is closed"):
            await waits

    run(main())


def test_a_condition_is_looked_at_in_the_event_loop_and_may_ask_the_client():
    async def main() -> None:
        async with AsyncClient() as client:
            assert await client.wait(lambda: client.is_reachable("a"), PATIENCE_S)
            assert not await client.wait(lambda: client.is_connected("nowhere"), 0.01)

    run(main())


def test_what_the_client_says_is_said_in_the_event_loop(counting: CountingAgents):
    async def main() -> None:
        said: list[tuple[str, bool]] = []

        def say(text: str) -> None:
            said.append((text, asyncio.get_running_loop() is loop))

        loop = asyncio.get_running_loop()
        async with AsyncClient(say=say) as client:
            await client.agents()
            with counting.frozen(counting.b):
                await client.agents(timeout_s=0.3)
            await asyncio.sleep(0)
        ((text, ours),) = said
        assert ours and text.startswith("b (")

    run(main())
