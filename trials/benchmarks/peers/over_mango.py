"""Two processes with mango: an agent in a TCP container in each, with its JSON codec, as its guide has it.

python over_mango.py far
python over_mango.py near ADDRESS

JSON has no bytes, so the data is text of the same length.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import time
from typing import Any

from mango import Agent, AgentAddress, activate, create_tcp_container, sender_addr
from talk import hear, say


def free_port() -> int:
    """Returns a port that nobody uses."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port


def packet(kind: str, number: int, data: str) -> dict[str, Any]:
    """Returns a packet with all that one of Pancakes' says about itself."""
    return {
        "channel": "bench",
        "kind": kind,
        "source": "near/client/Near",
        "destination": "far/client/Far",
        "stamp": time.monotonic(),
        "number": number,
        "data": data,
    }


class Far(Agent):
    """Answers pings, and acknowledges the last of what comes one way."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def handle_message(self, content: Any, meta: Any) -> None:
        if content["kind"] == "ping":
            self.count = 0
            answer = packet("pong", content["number"], content["data"])
        else:
            self.count += 1
            if content["number"] >= 0:
                return
            answer = packet("got", self.count, "")
        self.schedule_instant_message(answer, sender_addr(meta))


class Near(Agent):
    """Asks, and waits for each answer."""

    def __init__(self) -> None:
        super().__init__()
        self.answer: asyncio.Future[Any] | None = None

    def handle_message(self, content: Any, meta: Any) -> None:
        if self.answer is not None and not self.answer.done():
            self.answer.set_result(content)

    async def ask(self, asked: dict[str, Any], to: AgentAddress) -> Any:
        """Sends a packet, and returns the next that comes."""
        self.answer = asyncio.get_running_loop().create_future()
        await self.send_message(asked, to)
        return await self.answer


async def far() -> None:
    """Runs until its input ends."""
    port = free_port()
    container = create_tcp_container(("127.0.0.1", port))
    container.register(Far())
    async with activate(container):
        say(at=str(port))
        await asyncio.to_thread(hear)


async def near(port: int) -> None:
    """Measures round trips, then packets one way."""
    container = create_tcp_container(("127.0.0.1", free_port()))
    agent = container.register(Near())
    to = AgentAddress(("127.0.0.1", port), "agent0")
    async with activate(container):
        plan = await asyncio.to_thread(hear)
        data, packets, times_s = "x" * plan["size"], plan["packets"], []
        for number in range(plan["round_trips"]):
            asked_s = time.perf_counter()
            await agent.ask(packet("ping", number, data), to)
            times_s.append(time.perf_counter() - asked_s)
        began_s = time.perf_counter()
        for number in range(packets - 1):
            await agent.send_message(packet("load", number, data), to)
        got = await agent.ask(packet("load", -1, data), to)
        say(times_s=times_s, per_s=packets / (time.perf_counter() - began_s), received=got["number"])
        await asyncio.to_thread(hear)


if __name__ == "__main__":
    asyncio.run(far() if sys.argv[1] == "far" else near(int(sys.argv[2])))
    os._exit(0)
