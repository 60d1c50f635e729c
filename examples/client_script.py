"""Talk to running agents from a script.

The script starts an agent, as `pancakes-agent --config robot1.toml` in another terminal would, so that there is
something to talk to.

$ python examples/client_script.py
robot1 has the devices ('load',)
3 readings, each a share: True
robot1/device/load is running at 5.0 Hz
robot1/device/load is running at 2.0 Hz
ControlRefusedError: robot1 has no task or service 'lod', did you mean 'load'?
"""

import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from pancakes import Client, PancakesError
from pancakes.devices import Load

ROBOT1 = """
schema = 1

[agent]
name = "robot1"
fleet = "examples"
state_dir = "{folder}/state"

[device.load]
driver = "host.load"
rate_hz = 10
"""


@contextmanager
def robot1() -> Generator[None, None, None]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "robot1.toml")
        file.write_text(ROBOT1.format(folder=folder))
        program = Path(sys.executable).with_name("pancakes-agent")
        with subprocess.Popen([program, "--config", file], stderr=subprocess.DEVNULL) as agent:
            try:
                yield
            finally:
                agent.terminate()


with robot1(), Client(fleet="examples", timeout_s=20.0) as client:
    client.wait(lambda: client.is_reachable("robot1"))
    (agent,) = client.agents()
    print(agent.agent, "has the devices", agent.devices)

    with client.subscribe("robot1/system", Load) as loads:
        readings = [packet.body for packet in islice(loads, 3)]
    print(len(readings), "readings, each a share:", all(0.0 <= load.cpu <= 1.0 for load in readings))

    for rate_hz in (5.0, 2.0):
        client.set_rate("robot1/device/load", rate_hz)
        (device,) = (task for task in client.tasks("robot1") if task.service == "device")
        print(device, "is", device.state, "at", device.rate_hz, "Hz")

    try:
        client.stop("robot1/lod")
    except PancakesError as error:
        print(f"{type(error).__name__}: {error}")
