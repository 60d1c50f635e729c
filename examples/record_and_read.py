"""Record what is published, and read the recording in a program.

The table `[record]` records from the start. Recordings are MCAP files, which Foxglove and other programs open too.

$ python examples/record_and_read.py
robot1.mcap
0.5 s /robot1/system/pose from robot1/client/Walk: x_m = 0.1
1.0 s /robot1/system/pose from robot1/client/Walk: x_m = 0.2
1.5 s /robot1/system/pose from robot1/client/Walk: x_m = 0.3
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from pancakes import SYSTEM, RecordingReader, Simulation, Task, Tick, every
from pancakes.devices import Pose


@dataclass
class WalkState:
    x_m: float = 0.0


class Walk(Task[None, WalkState]):
    @every(hz=2)
    def step(self, tick: Tick) -> None:
        self.state.x_m = round(self.state.x_m + 0.1, 3)
        self.publish(SYSTEM, Pose(self.state.x_m, 0.0, 0.0))


with tempfile.TemporaryDirectory() as folder:
    record = f'[record]\npath = "{folder}/{{agent}}.mcap"\nchannels = ["system"]\ntypes = ["pose"]\n'
    with Simulation() as simulation:
        simulation.add("robot1", record, tasks={"Walk": Walk})
        simulation.reset(seed=1)
        simulation.step(1.7)
    print(*(file.name for file in Path(folder).iterdir()))
    for entry in RecordingReader(Path(folder)).entries():
        packet = entry.packet
        print(f"{packet.stamp_s:.1f} s {entry.topic} from {packet.source}: x_m = {packet.body.x_m}")
