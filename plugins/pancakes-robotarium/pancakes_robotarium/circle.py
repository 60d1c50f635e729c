"""`Circle`: go round a place, or round somebody, wherever the robot is pushed to on the way (`robotarium.Circle`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from pancakes import CTRL, SYSTEM, NotNegative, Packet, Positive, Task, agent_of, on
from pancakes.devices import Pose, RobotPose, Twist
from pancakes_encirclement.laps import Laps

FRESH_S: Final = 3.0
"""A subject that was not heard of for so long is nowhere."""
ON_CIRCLE_M: Final = 0.03
"""A robot that is so near to its circle is on it."""


def course_rad(place: tuple[float, float], centre: tuple[float, float], radius_m: float, pull_per_m: float) -> float:
    """Return where a robot should head to get on a circle, and then round it clockwise.

    A field of directions, unlike a law of curvature, brings a robot back from every place and every heading: what keeps
    robots apart may turn it round at any time.

    Args:
        place: where it is.
        centre: the centre of the circle.
        radius_m: its radius.
        pull_per_m: how strongly the robot is drawn to it, for each metre that it is off.
    """
    outwards_rad = math.atan2(place[1] - centre[1], place[0] - centre[0])
    inwards = math.atan(pull_per_m * (math.dist(place, centre) - radius_m))
    return outwards_rad - 0.5 * math.pi - inwards


class Circle(Task):
    """Drive round a place or a subject, clockwise, with no eye for obstacles: a barrier is below it (docs/filters.md).

    Events: `on_circle` (once on each host) and `revolution`.
    """

    requires = ("pose", "motors")
    offers = ("centre_m",)

    @dataclass
    class Settings:
        """The circle, and how to drive on it.

        Attributes:
            centre_m: its centre, (x, y) in the frame of the world; None: `subject` says where that is.
            subject: a robot or another body that it goes round, by the name in the `robot_pose` that tells where it is.
            radius_m: its radius.
            speed_mps: how fast it drives.
            pull_per_m: how strongly it is drawn to the circle.
            turn_per_s: how fast it turns, for each radian that it is off its course.
        """

        centre_m: tuple[float, float] | None = None
        subject: str = ""
        radius_m: Positive = 0.27
        speed_mps: Positive = 0.1
        pull_per_m: NotNegative = 5.0
        turn_per_s: Positive = 2.5

        def __post_init__(self) -> None:
            if (self.centre_m is None) == (not self.subject):
                raise ValueError("a circle needs either centre_m or subject")

    @dataclass
    class State:
        """The state that migrates with the task.

        Attributes:
            centre_m: the place that it goes round.
            revolutions: how often it went round, summed over all hosts.
        """

        centre_m: tuple[float, float] | None = None
        revolutions: float = 0.0

    settings: Settings
    state: State

    def on_start(self) -> None:
        self._arrived = False
        self._heard_s = -math.inf
        self._laps = Laps(self.state.revolutions)
        self.on_settings()

    def on_settings(self) -> None:
        """Go round the new place."""
        if self.settings.centre_m is not None:
            self.state.centre_m = self.settings.centre_m
            self._laps.recentred()

    @on(SYSTEM, RobotPose)
    def subject_seen(self, packet: Packet) -> None:
        """Take where the subject is."""
        body = packet.body
        if body.robot == self.settings.subject and math.isfinite(body.x_m) and math.isfinite(body.y_m):
            self.state.centre_m, self._heard_s = (body.x_m, body.y_m), self.now()

    @on(SYSTEM, Pose, queue="latest")
    def steer(self, packet: Packet) -> None:
        """Drive on from the robot's present pose."""
        if agent_of(packet.source) != self.agent:
            return
        pose, it, centre = packet.body, self.settings, self.state.centre_m
        if centre is None or (it.subject and self.now() > self._heard_s + FRESH_S):
            self.publish(CTRL, Twist(0.0, 0.0))
            return
        place = (pose.x_m, pose.y_m)
        self._count(place, centre)
        off_rad = math.remainder(course_rad(place, centre, it.radius_m, it.pull_per_m) - pose.theta_rad, math.tau)
        speed_mps = it.speed_mps * max(0.0, math.cos(off_rad))
        round_radps = -speed_mps / max(math.dist(place, centre), it.radius_m)
        self.publish(CTRL, Twist(speed_mps, it.turn_per_s * off_rad + round_radps))

    def _count(self, place: tuple[float, float], centre: tuple[float, float]) -> None:
        if not self._arrived and abs(math.dist(place, centre) - self.settings.radius_m) < ON_CIRCLE_M:
            self._arrived = True
            self.event("on_circle", radius_m=math.dist(place, centre))
        if not self._arrived:
            return
        whole = self._laps.passed(place, centre)
        self.state.revolutions = self._laps.revolutions
        if whole:
            self.event("revolution", count=math.floor(self.state.revolutions))
