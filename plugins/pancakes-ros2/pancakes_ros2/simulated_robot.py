"""One body of a simulated world as a node of ROS 2, `/NAME/base`, behind standard topics."""

from __future__ import annotations

import math
from typing import Any, Final

from pancakes.devices import Twist
from pancakes.sim.robot_models import DriveKinematics
from pancakes.sim.world import Physics
from pancakes_ros2.conversion import (
    BATTERY,
    BOOL,
    CONVERSIONS,
    ODOMETRY,
    POSE,
    POSE_COVARIANCE,
    RANGE,
    SCAN,
    TWIST,
    Moment,
    read_twist,
)
from pancakes_ros2.installation import message_class
from pancakes_ros2.quality import COMMAND, READING, Quality, profile_of
from pancakes_ros2.ros_motors import TEXT

TIMES_OUT_S: Final = 0.4
"""After so long without a command the robot stands still, in mission seconds: its firmware's own time-out."""
POSE_HZ: Final = 10.0
RANGE_HZ: Final = 2.5
BATTERY_HZ: Final = 1.0
MOTION_HZ: Final = 5.0
POSES: Final = (("odom", ODOMETRY), ("pose", POSE), ("amcl_pose", POSE_COVARIANCE))
"""Where the body is: by its odometry, which is without fault here, by a motion capture, and as amcl says it."""


class SimulatedRobot:
    """A robot, or a sensor node.

    Args:
        node: its rclpy node.
        name: its name in the world.
        physics: the world.
        wheels: what its wheels are like; None: it has none.
        types: the types of its sensors, as the world knows them.
    """

    def __init__(
        self, node: Any, name: str, physics: Physics, wheels: DriveKinematics | None, types: tuple[str, ...]
    ) -> None:
        self._node = node
        self._name = name
        self._physics = physics
        self._wheels = wheels
        self._task = ""
        self._publishers: dict[str, Any] = {}
        self._due: dict[str, tuple[float, float]] = {"pose": (0.0, 1.0 / POSE_HZ)}
        for kind in types:
            hz = {"battery": BATTERY_HZ, "motion": MOTION_HZ}.get(kind, RANGE_HZ)
            self._due[kind] = (0.0, 1.0 / hz)
        if wheels is not None:
            newest = profile_of(Quality("reliable", "transient_local", 1))
            node.create_subscription(message_class(TEXT), f"/{name}/cmd_vel_task", self._heard_task, newest)
            node.create_subscription(message_class(TWIST), f"/{name}/cmd_vel", self._heard_command, profile_of(COMMAND))

    def _heard_task(self, message: Any) -> None:
        self._task = message.data

    def _heard_command(self, message: Any) -> None:
        command = read_twist(message)
        if command == Twist(0.0, 0.0):
            self._physics.hold(self._name)
        elif self._wheels is not None:
            self._physics.drive(self._name, self._wheels.wheels(command), TIMES_OUT_S, self._task)

    def publish(self, now_s: float) -> None:
        """Publishes the readings that are due."""
        for kind, (due_s, period_s) in self._due.items():
            if now_s < due_s:
                continue
            self._due[kind] = (max(due_s + period_s, now_s), period_s)
            body = self._physics.sample(self._name, kind)
            if kind == "pose":
                for topic, message in POSES:
                    self._say("pose", message, topic, body, 0)
            elif kind == "sonar":
                self._say(kind, SCAN, kind, body, 0)
            elif kind == "ir":
                for number in range(len(body.ranges_m)):
                    self._say(kind, RANGE, f"{kind}_{number}", body, number)
            elif kind == "battery":
                self._say(kind, BATTERY, "battery_state", body, 0)
            else:
                self._say(kind, BOOL, kind, body, 0)

    def next_s(self) -> float:
        """Returns when the next reading is due."""
        return min((due_s for due_s, _ in self._due.values()), default=math.inf)

    def _say(self, packet: str, kind: str, topic: str, body: Any, part: int) -> None:
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self._node.create_publisher(message_class(kind), f"/{self._name}/{topic}", profile_of(READING))
            self._publishers[topic] = publisher
        if not publisher.get_subscription_count():
            return
        write = CONVERSIONS[packet, kind].write
        seconds, nanoseconds = divmod(self._node.get_clock().now().nanoseconds, 1_000_000_000)
        frame = "map" if packet == "pose" else f"{self._name}/{topic}"
        message = publisher.msg_type()
        write(message, body, Moment(seconds, nanoseconds, frame), part)
        publisher.publish(message)
