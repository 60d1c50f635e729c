"""`PoseSharing`: tell the neighbours where this robot is."""

from __future__ import annotations

from pancakes import NEIGHBOURS, SYSTEM, Packet, Task, Tick, agent_of, every, on
from pancakes.devices import Pose
from pancakes_encirclement.packets import NeighbourPose


class PoseSharing(Task):
    """Publish the robot's own pose to its neighbours, five times a second unless it is rescheduled."""

    requires = ("pose",)
    _pose: Pose | None = None

    @on(SYSTEM, Pose, queue="latest")
    def moved(self, packet: Packet) -> None:
        """Remember the newest pose."""
        if agent_of(packet.source) == self.agent:
            self._pose = packet.body

    @every(hz=5)
    def share(self, tick: Tick) -> None:
        """Tell it."""
        if self._pose is not None:
            pose = NeighbourPose(self._pose.x_m, self._pose.y_m, self._pose.theta_rad)
            self.publish(SYSTEM, pose, to=NEIGHBOURS)
