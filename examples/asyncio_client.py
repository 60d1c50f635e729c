"""Talk to several agents at once with asyncio.

The script starts two agents, as two terminals with `pancakes-agent --config FILE` would.

$ python examples/asyncio_client.py
robot1: 2 readings
robot2: 2 readings
both at 5.0 Hz
"""

import asyncio
import sys
import tempfile
from pathlib import Path

from pancakes import AsyncClient
from pancakes.devices import Load

ROBOT = """
schema = 1

[agent]
name = "{name}"
fleet = "examples"
state_dir = "{folder}/state-{name}"
peers = ["local://robot1", "local://robot2"]

[device.load]
driver = "host.load"
rate_hz = 10
"""
NAMES = ("robot1", "robot2")


async def start(name: str, folder: str) -> asyncio.subprocess.Process:
    """Start an agent."""
    file = Path(folder, f"{name}.toml")
    file.write_text(ROBOT.format(name=name, folder=folder))
    program = Path(sys.executable).with_name("pancakes-agent")
    return await asyncio.create_subprocess_exec(program, "--config", file, stderr=asyncio.subprocess.DEVNULL)


async def listen(client: AsyncClient, name: str) -> str:
    """Return how many readings were heard."""
    heard: list[Load] = []
    async with client.subscribe(f"{name}/system", Load) as loads:
        async for packet in loads:
            heard.append(packet.body)
            if len(heard) == 2:
                break
    return f"{name}: {len(heard)} readings"


async def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        agents = [await start(name, folder) for name in NAMES]
        try:
            async with AsyncClient(fleet="examples", timeout_s=20.0) as client:
                for name in NAMES:
                    while not await client.is_reachable(name):
                        await asyncio.sleep(0.1)
                print(*await asyncio.gather(*(listen(client, name) for name in NAMES)), sep="\n")
                await asyncio.gather(*(client.set_rate(f"{name}/device/load", 5.0) for name in NAMES))
                rates = {task.rate_hz for task in await client.tasks() if task.service == "device"}
                print("both at", *rates, "Hz")
        finally:
            for agent in agents:
                agent.terminate()
                await agent.wait()


asyncio.run(main())
