"""Read a sensor of another robot as if it were your own.

A camera on the ceiling sees robot1, and sends the pose to the device `robot1/device/pose`. The driver `network.pose`
publishes it there, so a task of robot1 that requires a pose runs as on a robot with a sensor for it.

$ python examples/read_a_sensor_of_another_robot.py
robot1 is at (0.1, 0.0) m, says robot1/device/pose
robot1 is at (0.2, 0.0) m, says robot1/device/pose
robot1 is at (0.3, 0.0) m, says robot1/device/pose
"""

from dataclasses import dataclass

from pancakes import SYSTEM, Packet, Simulation, Task, Tick, every, on
from pancakes.devices import Pose


@dataclass
class CameraState:
    x_m: float = 0.0


class Camera(Task[None, CameraState]):
    """Stands for a motion capture."""

    @every(hz=2)
    def see(self, tick: Tick) -> None:
        self.state.x_m = round(self.state.x_m + 0.1, 3)
        self.publish(SYSTEM, Pose(self.state.x_m, 0.0, 0.0), to="robot1/device/pose")


class Walk(Task):
    requires = ("pose",)

    @on(SYSTEM, queue="latest")
    def located(self, pose: Pose, packet: Packet[Pose]) -> None:
        print(f"{self.agent} is at ({pose.x_m}, {pose.y_m}) m, says {packet.source}")


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Walk": Walk}, devices={"pose": "network.pose"})
    simulation.add("ceiling", tasks={"Camera": Camera})
    simulation.reset(seed=1)
    simulation.step(1.7)
