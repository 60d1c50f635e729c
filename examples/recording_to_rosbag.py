"""Write a recording as a bag of ROS 2, and read the bag with `rosbags`, as a program that knows nothing of Pancakes.

The other way is `pancakes rosbag import`. Both need pancakes-ros2 and rosbags, and no ROS 2.

$ python examples/recording_to_rosbag.py
/robot1/laser sensor_msgs/msg/LaserScan: 10
/robot1/wheels sensor_msgs/msg/JointState: 20
at the end the wheels have turned by 9.7 rad
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

from pancakes import CTRL, Simulation, Task, Tick, every
from pancakes.devices import Twist

BUS = "tcp://world:7499"
PANCAKES = (sys.executable, "-m", "pancakes.tools.cli.main")


class Drive(Task):
    requires = ("motors",)

    @every(hz=10)
    def step(self, tick: Tick) -> None:
        self.publish(CTRL, Twist(0.5, 0.0))


def record(folder: Path) -> None:
    """Record a simulated robot for two seconds."""
    table = f'[record]\npath = "{folder}/{{agent}}.mcap"\nchannels = ["system"]\n'
    with Simulation() as simulation:
        robot = {"x_m": -1.5, "y_m": 0.0, "model": "pioneer3dx"}
        room = {"bus": BUS, "robots": {"robot1": robot}, "noise": {"wheel": 0.0}}
        simulation.add("world", tasks={"World": {"type": "sim.world", "settings": room}})
        devices = {
            "laser": {"type": "sim.laser_scan", "rate_hz": 5, "settings": {"world": BUS}},
            "wheels": {"type": "sim.encoders", "rate_hz": 10, "settings": {"world": BUS}},
            "motors": {"type": "sim.differential_drive", "settings": {"world": BUS, "model": "pioneer3dx"}},
        }
        simulation.add("robot1", table, tasks={"Drive": Drive}, devices=devices)
        simulation.reset(seed=1)
        simulation.step(2.05)


with tempfile.TemporaryDirectory() as place:
    recording, bag = Path(place, "recording"), Path(place, "bag")
    record(recording)
    subprocess.run([*PANCAKES, "rosbag", "export", recording, "--out", bag], check=True, stdout=subprocess.DEVNULL)
    with AnyReader([bag]) as reader:
        for connection in sorted(reader.connections, key=lambda it: it.topic):
            print(f"{connection.topic} {connection.msgtype}: {connection.msgcount}")
        wheels = [it for it in reader.connections if it.topic == "/robot1/wheels"]
        *_, (connection, _, data) = reader.messages(connections=wheels)
        message: Any = reader.deserialize(data, connection.msgtype)
        print(f"at the end the wheels have turned by {message.position[0]:.1f} rad")
