"""Write what the robots of a fleet share once: a file that others extend, and variables.

The script writes the files into a folder of its own, and asks `pancakes config` what they come to.

$ python examples/share_a_configuration.py
robot1.toml is sound: the agent robot1 of the fleet field
robot2.toml is sound: the agent robot2 of the fleet field
name = "robot1" # robot1.toml:6
fleet = "field" # field.toml:8
peers = ["tcp://192.168.1.20:7401"] # field.toml:9 (gateway: field.toml:5)
rate_hz = 5.0 # robot1.toml:9
"""

import subprocess
import sys
import tempfile
from pathlib import Path

FIELD = """
schema = 1

[vars]
gateway = "192.168.1.20"

[agent]
fleet = "field"
peers = ["tcp://${gateway}"]

[device.load]
driver = "host.load"
rate_hz = 1
"""
ROBOT1 = """
schema = 1
extends = "field.toml"

[agent]
name = "robot1"

[device.load]
rate_hz = 5
"""
ROBOT2 = """
schema = 1
extends = "field.toml"

[agent]
name = "robot2"
"""


def pancakes(*arguments: str) -> str:
    """Return what the command prints in the folder."""
    program = Path(sys.executable).with_name("pancakes")
    return subprocess.run([program, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


with tempfile.TemporaryDirectory() as folder:
    for name, text in (("field", FIELD), ("robot1", ROBOT1), ("robot2", ROBOT2)):
        Path(folder, f"{name}.toml").write_text(text)
    print(pancakes("config", "check", "."), end="")
    shown = pancakes("config", "show", "robot1.toml").splitlines()
    for key in ("name", "fleet", "peers", "rate_hz"):
        print(next(line for line in shown if line.startswith(f"{key} = ")))
