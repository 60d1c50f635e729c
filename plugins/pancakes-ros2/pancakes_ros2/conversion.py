"""What a packet is as a message of ROS 2, and a message as a packet. Pure: messages are what has their fields.

Lengths are metres, angles radians counter-clockwise (REP 103) and times seconds on both sides. Encoders, IMU, GPS fix,
laser scan, camera and 3-D poses are in `sensor_conversion.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from pancakes.devices import Battery, Infrared, Motion, Pose, Sonar, Temperature, Twist
from pancakes.devices.validation import level_of
from pancakes.errors import PancakesError
from pancakes_ros2.message_fields import Conversion, Moment, Unusable, finite, not_read, stamp, yaw
from pancakes_ros2.sensor_conversion import ODOMETRY, POSE, POSE_COVARIANCE, SCAN, SENSORS

INFRARED: Final = 1
ULTRASOUND: Final = 0
"""`radiation_type` of sensor_msgs/Range."""
EQUAL_RAD: Final = 1e-3
"""Steps of a ring that differ by less are equal."""


def read_pose(pose: Any) -> Pose:
    """Reads a geometry_msgs/Pose."""
    position, orientation = pose.position, pose.orientation
    finite("the pose", position.x, position.y, orientation.x, orientation.y, orientation.z, orientation.w)
    if orientation.x == orientation.y == orientation.z == orientation.w == 0.0:
        raise Unusable("the pose has no orientation: its quaternion is zero")
    return Pose(position.x, position.y, yaw(orientation))


def write_pose(pose: Any, body: Pose) -> None:
    """Fills a geometry_msgs/Pose."""
    finite("the pose", body.x_m, body.y_m, body.theta_rad)
    pose.position.x, pose.position.y = float(body.x_m), float(body.y_m)
    pose.orientation.z, pose.orientation.w = math.sin(body.theta_rad / 2), math.cos(body.theta_rad / 2)


def read_twist(twist: Any) -> Twist:
    """Reads a geometry_msgs/Twist."""
    finite("the speed", twist.linear.x, twist.angular.z)
    return Twist(twist.linear.x, twist.angular.z)


def write_twist(twist: Any, body: Twist) -> None:
    """Fills a geometry_msgs/Twist."""
    finite("the speed", body.v_mps, body.omega_radps)
    twist.linear.x, twist.angular.z = float(body.v_mps), float(body.omega_radps)


def read_battery(message: Any, full: float = 1.0) -> Battery:
    """Reads a sensor_msgs/BatteryState; the voltage is NaN if the robot does not measure it.

    Args:
        message: the message.
        full: its percentage when the battery is full: 1 by the definition of the message; many robots say 100.
    """
    if math.isnan(message.percentage):
        raise Unusable("the battery does not say how full it is (percentage is NaN)")
    try:
        level = level_of(message.percentage, full)
    except PancakesError as error:
        raise Unusable(str(error)) from None
    return Battery(message.voltage if math.isfinite(message.voltage) else math.nan, level)


def _write_battery(message: Any, body: Battery, moment: Moment, part: int) -> None:
    stamp(message.header, moment)
    message.voltage, message.percentage, message.present = body.voltage_v, body.level, True
    for unknown in ("temperature", "current", "charge", "capacity", "design_capacity"):
        setattr(message, unknown, math.nan)


def _measured(distance: float) -> bool:
    return distance >= 0.0 or distance == -math.inf  # the latter says that it is too near to tell


def read_range(message: Any) -> tuple[float, float] | None:
    """Reads a sensor_msgs/Range (REP 117).

    Returns:
        The distance, `max_range` where nothing is seen and 0 where it is too near to tell; and `max_range`. None: it is
        no measurement: NaN, or a negative number.
    """
    distance, most = message.range, message.max_range
    if not _measured(distance) or not (math.isfinite(most) and most > 0):
        return None
    return min(most, max(0.0, distance)), most


def _write_range(radiation: int) -> Callable[[Any, Any, Moment, int], None]:
    def write(message: Any, body: Infrared | Sonar, moment: Moment, part: int) -> None:
        stamp(message.header, moment)
        message.radiation_type, message.min_range, message.max_range = radiation, 0.0, body.max_range_m
        seen = body.ranges_m[part]
        message.range = math.inf if seen >= body.max_range_m else seen

    return write


def _read_scan(kind: type[Infrared] | type[Sonar]) -> Callable[[Any], Any]:
    def read(message: Any) -> Any:
        most = message.range_max
        finite("the scan", message.angle_min, message.angle_increment, most)
        rays = [
            (message.angle_min + number * message.angle_increment, min(most, max(0.0, float(distance))))
            for number, distance in enumerate(message.ranges)
            if _measured(distance)
        ]
        if not rays:
            raise Unusable("the scan has no ray that measured anything")
        bearings, ranges = zip(*rays, strict=True)
        return kind(bearings, ranges, most)

    return read


def _write_scan(message: Any, body: Infrared | Sonar, moment: Moment, part: int) -> None:
    bearings = body.bearings_rad
    if not bearings:
        raise Unusable("no sensor of the ring measured anything")
    step = (bearings[-1] - bearings[0]) / max(1, len(bearings) - 1)
    if any(abs(bearing - bearings[0] - number * step) > EQUAL_RAD for number, bearing in enumerate(bearings)):
        raise Unusable("its rays do not stand at equal steps, as those of a LaserScan do: use sensor_msgs/msg/Range")
    stamp(message.header, moment)
    message.angle_min, message.angle_max, message.angle_increment = bearings[0], bearings[-1], step
    message.range_min, message.range_max = 0.0, body.max_range_m
    message.ranges = [math.inf if seen >= body.max_range_m else seen for seen in body.ranges_m]


def _write_pose_stamped(message: Any, body: Pose, moment: Moment, part: int) -> None:
    stamp(message.header, moment)
    write_pose(message.pose, body)


def _write_pose_within(message: Any, body: Pose, moment: Moment, part: int) -> None:
    stamp(message.header, moment)
    write_pose(message.pose.pose, body)


def _write_twist_stamped(message: Any, body: Twist, moment: Moment, part: int) -> None:
    finite("the speed", body.v_mps, body.omega_radps)
    stamp(message.header, moment)
    write_twist(message.twist, body)


def _read_temperature(message: Any) -> Temperature:
    finite("the temperature", message.temperature)
    return Temperature(message.temperature)


def _write_temperature(message: Any, body: Temperature, moment: Moment, part: int) -> None:
    stamp(message.header, moment)
    message.temperature = body.celsius


def _write_motion(message: Any, body: Motion, moment: Moment, part: int) -> None:
    message.data = body.detected


def _count(body: Infrared | Sonar) -> int:
    return len(body.ranges_m)


TWIST: Final = "geometry_msgs/msg/Twist"
TWIST_STAMPED: Final = "geometry_msgs/msg/TwistStamped"
BATTERY: Final = "sensor_msgs/msg/BatteryState"
RANGE: Final = "sensor_msgs/msg/Range"
BOOL: Final = "std_msgs/msg/Bool"
TEMPERATURE: Final = "sensor_msgs/msg/Temperature"

CONVERSIONS: Final = {
    ("pose", POSE): Conversion(lambda message: read_pose(message.pose), _write_pose_stamped),
    ("pose", ODOMETRY): Conversion(lambda message: read_pose(message.pose.pose), _write_pose_within),
    ("pose", POSE_COVARIANCE): Conversion(lambda message: read_pose(message.pose.pose), _write_pose_within),
    ("motors", TWIST): Conversion(read_twist, lambda message, body, moment, part: write_twist(message, body)),
    ("motors", TWIST_STAMPED): Conversion(lambda message: read_twist(message.twist), _write_twist_stamped),
    ("battery", BATTERY): Conversion(read_battery, _write_battery),
    ("ir", SCAN): Conversion(_read_scan(Infrared), _write_scan),
    ("sonar", SCAN): Conversion(_read_scan(Sonar), _write_scan),
    ("ir", RANGE): Conversion(not_read, _write_range(INFRARED), _count),
    ("sonar", RANGE): Conversion(not_read, _write_range(ULTRASOUND), _count),
    ("motion", BOOL): Conversion(lambda message: Motion(message.data), _write_motion),
    ("temperature", TEMPERATURE): Conversion(_read_temperature, _write_temperature),
    **SENSORS,
}
"""By packet type and message type: what the devices of the core are in ROS 2."""


def messages_of(packet: str) -> Sequence[str]:
    """Returns the message types of which one message is read as a packet of a type."""
    return [
        kind for (name, kind), conversion in CONVERSIONS.items() if name == packet and conversion.read is not not_read
    ]
