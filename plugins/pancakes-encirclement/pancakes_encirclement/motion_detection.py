"""`MotionDetection`: tell the neighbours that something moves here (paper §4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pancakes import NEIGHBOURS, SYSTEM, NotNegative, Packet, Task, agent_of, on
from pancakes.devices import Motion, Pose
from pancakes_encirclement.packets import MotionDetected


def place_of(motion: Motion, pose: Pose) -> tuple[float, float] | None:
    """Return where in the world a motion sensor at `pose` sees something move.

    Returns:
        None if the sensor cannot measure it.
    """
    if motion.bearing_rad is None or motion.range_m is None:
        return None
    direction = pose.theta_rad + motion.bearing_rad
    return pose.x_m + motion.range_m * math.cos(direction), pose.y_m + motion.range_m * math.sin(direction)


QUIET_S = 10.0
"""After this time without motion, new motion is an event."""


class MotionDetection(Task):
    """Send the sensor's place to the neighbours when it senses motion, as in the paper.

    Event: `motion_detected`, when motion begins; not for each report.
    """

    requires = ("motion", "pose")

    @dataclass
    class Settings:
        """What to send, and how often.

        Attributes:
            period_s: at most one report in this time.
            locate: send the measured place of the motion instead of the sensor's own.
        """

        period_s: NotNegative = 2.0
        locate: bool = False

    settings: Settings

    def on_start(self) -> None:
        self._pose: Pose | None = None
        self._next_s = -math.inf
        self._last_s = -math.inf

    @on(SYSTEM, Pose, queue="latest")
    def moved(self, packet: Packet) -> None:
        """Remember where the sensor is."""
        if agent_of(packet.source) == self.agent:
            self._pose = packet.body

    @on(SYSTEM, Motion, queue="latest")
    def sensed(self, packet: Packet) -> None:
        """Take a reading of the motion sensor."""
        motion: Motion = packet.body
        if not motion.detected or self._pose is None:
            return
        news, self._last_s = self.now() - self._last_s > QUIET_S, self.now()
        if self.now() < self._next_s:
            return
        place = place_of(motion, self._pose) if self.settings.locate else (self._pose.x_m, self._pose.y_m)
        if place is None:
            return
        self._next_s = self.now() + self.settings.period_s
        self.publish(SYSTEM, MotionDetected(*place), to=NEIGHBOURS)
        if news:
            self.event("motion_detected", x_m=place[0], y_m=place[1])
