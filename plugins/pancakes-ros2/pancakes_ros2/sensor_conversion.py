"""What encoders, IMU, GPS fix, laser scan, camera and 3-D poses are in ROS 2, and transforms of tf. Pure.

A reading that names its frame is in that frame in ROS 2, and a message's frame is that of the reading.
"""

from __future__ import annotations

import math
from array import array
from typing import Any, Final

from pancakes.devices import LEVEL, CameraFrame, Encoders, GpsFix, Imu, LaserScan, Pose, Pose3D, Quaternion
from pancakes_ros2.message_fields import (
    Conversion,
    Moment,
    Unusable,
    fill_orientation,
    fill_vector,
    finite,
    frame_name,
    frame_of,
    made,
    not_read,
    orientation_of,
    stamp,
    vector_of,
)

JOINTS: Final = "sensor_msgs/msg/JointState"
IMU: Final = "sensor_msgs/msg/Imu"
FIX: Final = "sensor_msgs/msg/NavSatFix"
SCAN: Final = "sensor_msgs/msg/LaserScan"
IMAGE: Final = "sensor_msgs/msg/CompressedImage"
POSE: Final = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TRANSFORM: Final = "geometry_msgs/msg/TransformStamped"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"

STATIC_TOPIC: Final = "/tf_static"

NOT_MEASURED: Final = -1.0
"""The first number of a covariance in sensor_msgs/Imu if the unit does not measure what it is of."""
NO_FIX: Final = -1
"""`status` of sensor_msgs/NavSatStatus; below it, from Jazzy on, no receiver has said whether there is one."""
GPS: Final = 1
"""`service` of sensor_msgs/NavSatStatus."""
UNKNOWN: Final = 0
DIAGONAL: Final = 2
"""`position_covariance_type` of sensor_msgs/NavSatFix."""


def _stamp_sensor(header: Any, moment: Moment, frame: str) -> None:
    stamp(header, moment._replace(frame=frame or moment.frame))


def _read_encoders(message: Any) -> Encoders:
    names, angles, speeds = tuple(message.name), _floats(message.position), _floats(message.velocity)
    if not angles:
        raise Unusable("no joint says its position")
    finite("a position", *angles)
    finite("a velocity", *speeds)
    return made(Encoders, names, angles, speeds)


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _write_encoders(message: Any, body: Encoders, moment: Moment, part: int) -> None:
    finite("an angle", *body.angles_rad, *body.speeds_radps)
    stamp(message.header, moment)
    message.name = list(body.wheels)
    message.position, message.velocity = [*map(float, body.angles_rad)], [*map(float, body.speeds_radps)]


def _read_imu(message: Any) -> Imu:
    if message.angular_velocity_covariance[0] == NOT_MEASURED:
        raise Unusable("the unit does not measure its turning rate (angular_velocity_covariance[0] is -1)")
    if message.linear_acceleration_covariance[0] == NOT_MEASURED:
        raise Unusable("the unit does not measure its acceleration (linear_acceleration_covariance[0] is -1)")
    turn = vector_of("the turning rate", message.angular_velocity)
    acceleration = vector_of("the acceleration", message.linear_acceleration)
    told = message.orientation
    orientation: Quaternion | None = None
    # Drivers of units without an orientation say so with -1, or leave the quaternion at zero.
    if message.orientation_covariance[0] != NOT_MEASURED and any((told.x, told.y, told.z, told.w)):
        orientation = orientation_of("the unit", told)
    return made(Imu, turn, acceleration, orientation, frame_of(message.header))


def _write_imu(message: Any, body: Imu, moment: Moment, part: int) -> None:
    finite("the motion", *body.angular_radps, *body.acceleration_mps2, *(body.orientation or LEVEL))
    _stamp_sensor(message.header, moment, body.frame)
    fill_vector(message.angular_velocity, body.angular_radps)
    fill_vector(message.linear_acceleration, body.acceleration_mps2)
    fill_orientation(message.orientation, body.orientation or LEVEL)
    if body.orientation is None:
        message.orientation_covariance[0] = NOT_MEASURED


def _read_fix(message: Any) -> GpsFix:
    if message.status.status <= NO_FIX:
        raise Unusable(f"the receiver has no fix (status is {message.status.status})")
    finite("the position", message.latitude, message.longitude)
    latitude_deg, longitude_deg = float(message.latitude), float(message.longitude)
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        raise Unusable(f"{latitude_deg:g}, {longitude_deg:g} is no latitude and longitude in degrees")
    altitude_m = float(message.altitude) if math.isfinite(message.altitude) else None
    horizontal_m = vertical_m = None
    if message.position_covariance_type != UNKNOWN:
        east, north, up = (float(message.position_covariance[place]) for place in (0, 4, 8))
        horizontal_m, vertical_m = _deviation(max(east, north)), _deviation(up)
    return made(GpsFix, latitude_deg, longitude_deg, altitude_m, horizontal_m, vertical_m, frame_of(message.header))


def _deviation(variance: float) -> float | None:
    return math.sqrt(variance) if math.isfinite(variance) and variance >= 0.0 else None


def _write_fix(message: Any, body: GpsFix, moment: Moment, part: int) -> None:
    finite("the position", body.latitude_deg, body.longitude_deg)
    _stamp_sensor(message.header, moment, body.frame)
    message.status.status, message.status.service = 0, GPS
    message.latitude, message.longitude = float(body.latitude_deg), float(body.longitude_deg)
    message.altitude = math.nan if body.altitude_m is None else float(body.altitude_m)
    message.position_covariance_type = UNKNOWN
    if body.horizontal_m is not None and body.vertical_m is not None:
        for place, deviation_m in ((0, body.horizontal_m), (4, body.horizontal_m), (8, body.vertical_m)):
            message.position_covariance[place] = float(deviation_m) ** 2
        message.position_covariance_type = DIAGONAL


def _read_scan(message: Any) -> LaserScan:
    least, most = float(message.range_min), float(message.range_max)
    finite("the scan", message.angle_min, message.angle_increment, most)
    # REP 117: minus infinity is too near to tell; any other range below the least is no measurement.
    ranges = [math.nan if it < least and it != -math.inf else it for it in map(float, message.ranges)]
    start, step = float(message.angle_min), float(message.angle_increment)
    return made(LaserScan.of, start, step, ranges, most, frame_of(message.header))


def _write_scan(message: Any, body: LaserScan, moment: Moment, part: int) -> None:
    finite("the scan", body.start_rad, body.step_rad, body.max_range_m)
    _stamp_sensor(message.header, moment, body.frame)
    message.angle_min, message.angle_increment = float(body.start_rad), float(body.step_rad)
    message.angle_max = float(body.start_rad + body.step_rad * (len(body.ranges_mm) - 1))
    message.range_min, message.range_max = 0.0, float(body.max_range_m)
    full_mm = 1000 * body.max_range_m
    message.ranges = [math.nan if it == 0 else math.inf if it >= full_mm else it / 1000 for it in body.ranges_mm]


def _read_image(message: Any) -> CameraFrame:
    if not any(word in message.format.lower() for word in ("jpeg", "jpg")):
        raise Unusable(f"the image is {message.format!r}, and only JPEG is taken")
    return made(CameraFrame, bytes(message.data), frame_of(message.header))


def _write_image(message: Any, body: CameraFrame, moment: Moment, part: int) -> None:
    _stamp_sensor(message.header, moment, body.frame)
    message.format, message.data = "jpeg", array("B", body.jpeg)


def read_pose_3d(header: Any, pose: Any) -> Pose3D:
    """Read a geometry_msgs/Pose and the header that it came with.

    Raises:
        Unusable: it is no pose, or in no frame.
    """
    frame = frame_of(header)
    if not frame:
        raise Unusable("it does not name the frame that it is in (header.frame_id)")
    return made(Pose3D, frame, *vector_of("the pose", pose.position), orientation_of("the pose", pose.orientation))


def _write_pose_3d(pose: Any, header: Any, body: Pose3D, moment: Moment) -> None:
    finite("the pose", body.x_m, body.y_m, body.z_m, *body.orientation)
    stamp(header, moment._replace(frame=body.frame))
    fill_vector(pose.position, (body.x_m, body.y_m, body.z_m))
    fill_orientation(pose.orientation, body.orientation)


def read_transform(message: Any) -> tuple[Pose3D, str]:
    """Read a geometry_msgs/TransformStamped.

    Returns:
        The pose of the child frame in its parent, and the name of the child frame.

    Raises:
        Unusable: it is no transform.
    """
    parent, child = frame_of(message.header).lstrip("/"), frame_name(message.child_frame_id).lstrip("/")
    transform = message.transform
    if not parent or not child or parent == child:
        raise Unusable(f"a transform from {parent!r} to {child!r} has to name two frames")
    what = f"the transform from {parent} to {child}"
    place, turn = vector_of(what, transform.translation), orientation_of(what, transform.rotation)
    return made(Pose3D, parent, *place, turn), child


def _write_transform(message: Any, body: Pose | Pose3D, moment: Moment, part: int) -> None:
    if isinstance(body, Pose3D):
        moment = moment._replace(frame=body.frame)
        place, turn = (body.x_m, body.y_m, body.z_m), body.orientation
    else:
        finite("the pose", body.theta_rad)
        half_rad = body.theta_rad / 2
        place, turn = (body.x_m, body.y_m, 0.0), (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
    finite("the pose", *place, *turn)
    if moment.frame == moment.child:
        raise Unusable(f"a transform from {moment.frame} to itself: set `frame` or `child_frame`")
    stamp(message.header, moment)
    message.child_frame_id = moment.child
    fill_vector(message.transform.translation, place)
    fill_orientation(message.transform.rotation, turn)


def _write_transforms(message: Any, body: Pose | Pose3D, moment: Moment, part: int) -> None:
    _write_transform(message.transforms[0], body, moment, part)


_ITEM: Final = ("transforms", TRANSFORM)

SENSORS: Final = {
    ("encoders", JOINTS): Conversion(_read_encoders, _write_encoders),
    ("imu", IMU): Conversion(_read_imu, _write_imu),
    ("gps_fix", FIX): Conversion(_read_fix, _write_fix),
    ("laser_scan", SCAN): Conversion(_read_scan, _write_scan),
    ("camera", IMAGE): Conversion(_read_image, _write_image),
    ("pose_3d", POSE): Conversion(
        lambda message: read_pose_3d(message.header, message.pose),
        lambda message, body, moment, part: _write_pose_3d(message.pose, message.header, body, moment),
    ),
    ("pose_3d", ODOMETRY): Conversion(
        lambda message: read_pose_3d(message.header, message.pose.pose),
        lambda message, body, moment, part: _write_pose_3d(message.pose.pose, message.header, body, moment),
    ),
    ("pose_3d", POSE_COVARIANCE): Conversion(
        lambda message: read_pose_3d(message.header, message.pose.pose),
        lambda message, body, moment, part: _write_pose_3d(message.pose.pose, message.header, body, moment),
    ),
    ("pose", TRANSFORM): Conversion(lambda message: read_transform(message)[0].flat(), _write_transform),
    ("pose_3d", TRANSFORM): Conversion(lambda message: read_transform(message)[0], _write_transform),
    # What is read of tf depends on the transforms before it: `FrameTree`.
    ("pose", TRANSFORMS): Conversion(not_read, _write_transforms, item=_ITEM),
    ("pose_3d", TRANSFORMS): Conversion(not_read, _write_transforms, item=_ITEM),
}
"""By packet type and message type."""
