"""The motion capture (`sim.motion_capture`): sees every robot, and sends each its pose over the mesh (paper §4).

For the robot this is a virtual local sensor: its device `pose` has the driver `network.pose`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from pancakes.devices import Pose
from pancakes.devices.driver import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.settings import NotNegative, Positive
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.task import Task, on


def measured(body: BodyState, noise_m: float, noise_rad: float, normal: Callable[[], float]) -> Pose:
    """Return where cameras see a body, which is a little off; `normal` draws, with mean 0 and deviation 1."""
    theta_rad = body.theta_rad + noise_rad * normal()
    return Pose(
        body.x_m + noise_m * normal(),
        body.y_m + noise_m * normal(),
        math.pi - (math.pi - theta_rad) % math.tau,
    )


class MotionCapture(Task):
    """Send the poses of bodies to the agents that they belong to.

    Needs the task `sim.world` on the same agent, and can send no more often than that publishes its state.
    """

    @dataclass
    class Settings:
        """Which address gets which pose.

        Attributes:
            targets: the address that gets a body's pose, by the body's name: `agent1 = "agent1/device/pose"`.
            send_hz: how often.
            noise_m: standard deviation of each coordinate.
            noise_rad: standard deviation of the heading.
        """

        targets: dict[str, str] = field(default_factory=dict)
        send_hz: Positive = 10.0
        noise_m: NotNegative = 0.001
        noise_rad: NotNegative = 0.0087

    settings: Settings

    def on_start(self) -> None:
        self._pace = Pace(self.settings.send_hz)
        self._missing_told = False
        self._normal = self.random.gauss

    def on_settings(self) -> None:
        self._pace = Pace(self.settings.send_hz)
        self._missing_told = False

    @on(SYSTEM, WorldState)
    def seen(self, packet: Packet) -> None:
        """Send the poses, when it is time."""
        state: WorldState = packet.body
        if not self._pace.due(state.time_s):
            return
        bodies = {body.name: body for body in state.bodies}
        settings, missing = self.settings, []
        for name, target in settings.targets.items():
            body = bodies.get(name)
            if body is None:
                missing.append(name)
                continue
            self.publish(SYSTEM, measured(body, settings.noise_m, settings.noise_rad, self._normal), to=target)
        if missing and not self._missing_told:
            self._missing_told = True
            self.log("error", f"the motion capture has a target for {', '.join(missing)}, which the world has not")
