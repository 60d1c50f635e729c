"""What packets and messages become of each other. These tests need no ROS 2: a message is what has its fields."""

import math
from types import SimpleNamespace

import pytest
from devices.jpegs import jpeg
from pancakes_ros2.conversion import (
    BATTERY,
    BOOL,
    CONVERSIONS,
    ODOMETRY,
    POSE,
    POSE_COVARIANCE,
    RANGE,
    SCAN,
    TEMPERATURE,
    TWIST,
    TWIST_STAMPED,
    Moment,
    Unusable,
    messages_of,
    not_read,
    read_battery,
    read_range,
)
from pancakes_ros2.sensor_conversion import FIX, IMAGE, IMU, JOINTS, TRANSFORM, TRANSFORMS

from pancakes.devices import (
    MOST_JPEG_BYTES,
    Battery,
    CameraFrame,
    Encoders,
    GpsFix,
    Imu,
    Infrared,
    LaserScan,
    Motion,
    Pose,
    Pose3D,
    Sonar,
    Temperature,
    Twist,
)

NOW = Moment(12, 34, "map", "base_link")
HALF = math.sqrt(0.5)


def space(**fields):
    return SimpleNamespace(**fields)


def header():
    return space(stamp=space(sec=0, nanosec=0), frame_id="")


def pose():
    return space(position=space(x=0.0, y=0.0, z=0.0), orientation=space(x=0.0, y=0.0, z=0.0, w=1.0))


def twist():
    return space(linear=space(x=0.0, y=0.0, z=0.0), angular=space(x=0.0, y=0.0, z=0.0))


def turn():
    return space(x=0.0, y=0.0, z=0.0, w=1.0)


def vector():
    return space(x=0.0, y=0.0, z=0.0)


def transform():
    return space(header=header(), child_frame_id="", transform=space(translation=vector(), rotation=turn()))


def imu():
    return space(
        header=header(),
        orientation=turn(),
        orientation_covariance=[0.0] * 9,
        angular_velocity=vector(),
        angular_velocity_covariance=[0.0] * 9,
        linear_acceleration=vector(),
        linear_acceleration_covariance=[0.0] * 9,
    )


def fix():
    return space(header=header(), status=space(status=0, service=0), position_covariance=[0.0] * 9)


EMPTY = {
    POSE: lambda: space(header=header(), pose=pose()),
    ODOMETRY: lambda: space(header=header(), pose=space(pose=pose())),
    POSE_COVARIANCE: lambda: space(header=header(), pose=space(pose=pose())),
    TWIST: twist,
    TWIST_STAMPED: lambda: space(header=header(), twist=twist()),
    BATTERY: lambda: space(header=header()),
    SCAN: lambda: space(header=header()),
    RANGE: lambda: space(header=header()),
    BOOL: lambda: space(data=False),
    TEMPERATURE: lambda: space(header=header(), temperature=0.0),
    JOINTS: lambda: space(header=header()),
    IMU: imu,
    FIX: fix,
    IMAGE: lambda: space(header=header()),
    TRANSFORM: transform,
    TRANSFORMS: lambda: space(transforms=[transform()]),
}
BODIES = {
    "pose": Pose(1.5, -2.0, 3.0),
    "motors": Twist(0.25, -0.5),
    "battery": Battery(12.5, 0.75),
    "ir": Infrared((-0.5, 0.0, 0.5), (0.1, 0.3, 0.2), 0.3),
    "sonar": Sonar((-0.5, 0.0, 0.5), (1.0, 4.0, 2.0), 4.0),
    "motion": Motion(True),
    "temperature": Temperature(21.5),
    "encoders": Encoders(("left", "right"), (1.5, -2.0), (0.1, 0.2)),
    "imu": Imu((0.0, 0.0, 0.1), (0.0, 0.0, 9.81), (0.0, 0.0, HALF, HALF), "imu_link"),
    "gps_fix": GpsFix(52.5, 13.4, 34.0, 1.2, 2.5, "gps"),
    "laser_scan": LaserScan(-1.5, 0.5, (1000, 0, 4000), 4.0, "laser"),
    "camera": CameraFrame(jpeg(320, 240), "camera"),
    "pose_3d": Pose3D("odom", 1.0, 2.0, 3.0, (0.0, 0.0, HALF, HALF)),
}


@pytest.mark.parametrize(("packet", "kind"), [key for key, it in CONVERSIONS.items() if it.read is not not_read])
def test_what_is_written_is_read_again(packet, kind):
    conversion, message = CONVERSIONS[packet, kind], EMPTY[kind]()
    conversion.write(message, BODIES[packet], NOW, 0)
    read = conversion.read(message)
    assert type(read) is type(BODIES[packet])
    for field in read.__struct_fields__:
        assert getattr(read, field) == pytest.approx(getattr(BODIES[packet], field)), field
    if hasattr(message, "header"):
        frame = getattr(BODIES[packet], "frame", NOW.frame)
        assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (12, 34, frame)


@pytest.mark.parametrize("theta_rad", [-3.0, -0.1, 0.0, 1.0, math.pi])
def test_a_heading_is_a_turn_about_the_upright_axis(theta_rad):
    message = EMPTY[POSE]()
    CONVERSIONS["pose", POSE].write(message, Pose(0.0, 0.0, theta_rad), NOW, 0)
    orientation = message.pose.orientation
    assert orientation.x == orientation.y == 0.0
    assert math.hypot(orientation.z, orientation.w) == pytest.approx(1.0)
    assert CONVERSIONS["pose", POSE].read(message).theta_rad == pytest.approx(theta_rad)


def test_the_heading_of_a_robot_on_a_slope_is_its_yaw():
    message = EMPTY[ODOMETRY]()
    tilted = message.pose.pose.orientation
    # A turn by 0.5 rad to the left, then by 0.2 rad about the axis of the wheels.
    z, w, y, v = math.sin(0.25), math.cos(0.25), math.sin(0.1), math.cos(0.1)
    tilted.x, tilted.y, tilted.z, tilted.w = -z * y, w * y, z * v, w * v
    assert CONVERSIONS["pose", ODOMETRY].read(message).theta_rad == pytest.approx(0.5)


def test_where_a_ring_sees_nothing_the_message_says_infinity_and_the_packet_the_full_range():
    message = EMPTY[SCAN]()
    CONVERSIONS["ir", SCAN].write(message, BODIES["ir"], NOW, 0)
    assert message.ranges == [0.1, math.inf, 0.2]
    assert (message.angle_min, message.angle_max, message.angle_increment) == (-0.5, 0.5, 0.5)
    assert CONVERSIONS["ir", SCAN].read(message).ranges_m == (0.1, 0.3, 0.2)


def test_each_sensor_of_a_ring_is_a_range_with_its_radiation():
    conversion = CONVERSIONS["sonar", RANGE]
    assert conversion.parts is not None
    assert conversion.parts(BODIES["sonar"]) == 3
    message = EMPTY[RANGE]()
    conversion.write(message, BODIES["sonar"], NOW, 1)
    assert (message.radiation_type, message.range, message.max_range) == (0, math.inf, 4.0)
    CONVERSIONS["ir", RANGE].write(message, BODIES["ir"], NOW, 2)
    assert (message.radiation_type, message.range) == (1, 0.2)


@pytest.mark.parametrize(
    ("distance_m", "read"),
    [
        (0.5, (0.5, 2.0)),
        (math.inf, (2.0, 2.0)),
        (-math.inf, (0.0, 2.0)),
        (9.0, (2.0, 2.0)),
        (math.nan, None),
        (-1.0, None),
    ],
)
def test_a_range_is_read_as_rep_117_says(distance_m, read):
    assert read_range(space(range=distance_m, max_range=2.0)) == read


def test_rays_that_measured_nothing_are_left_out_of_a_scan():
    scan = space(angle_min=0.0, angle_increment=0.5, range_max=4.0, ranges=[1.0, math.nan, math.inf, -1.0])
    assert CONVERSIONS["sonar", SCAN].read(scan) == Sonar((0.0, 1.0), (1.0, 4.0), 4.0)


def test_a_ring_with_unequal_steps_is_no_scan():
    with pytest.raises(Unusable, match="do not stand at equal steps"):
        CONVERSIONS["ir", SCAN].write(EMPTY[SCAN](), Infrared((0.0, 0.5, 2.0), (0.1,) * 3, 0.3), NOW, 0)


def test_what_a_battery_does_not_know_is_nan_and_one_without_a_level_is_no_reading():
    message = EMPTY[BATTERY]()
    CONVERSIONS["battery", BATTERY].write(message, BODIES["battery"], NOW, 0)
    assert math.isnan(message.current) and math.isnan(message.temperature) and message.present
    message.percentage = math.nan
    with pytest.raises(Unusable, match="does not say how full it is"):
        CONVERSIONS["battery", BATTERY].read(message)


def test_a_battery_that_speaks_in_percent_is_not_full():
    message = EMPTY[BATTERY]()
    message.voltage, message.percentage = 12.0, 87.0
    with pytest.raises(Unusable, match="set full = 100 if it speaks in percent"):
        CONVERSIONS["battery", BATTERY].read(message)
    assert read_battery(message, 100.0) == Battery(12.0, 0.87)
    message.percentage = 1.0
    message.voltage = math.inf
    assert math.isnan(read_battery(message).voltage_v)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_pose_and_no_command_has_a_number_that_is_none(bad):
    message = EMPTY[POSE]()
    message.pose.position.x = bad
    for act in (
        lambda: CONVERSIONS["pose", POSE].read(message),
        lambda: CONVERSIONS["motors", TWIST].write(twist(), Twist(bad, 0.0), NOW, 0),
        lambda: CONVERSIONS["motors", TWIST_STAMPED].write(EMPTY[TWIST_STAMPED](), Twist(0.0, bad), NOW, 0),
        lambda: CONVERSIONS["temperature", TEMPERATURE].read(space(temperature=bad)),
        lambda: CONVERSIONS["pose", TRANSFORM].write(transform(), Pose(0.0, 0.0, bad), NOW, 0),
        lambda: CONVERSIONS["pose_3d", TRANSFORM].write(transform(), Pose3D("map", bad, 0.0, 0.0), NOW, 0),
    ):
        with pytest.raises(Unusable, match="is not finite"):
            act()


def test_a_pose_without_an_orientation_is_none():
    message = EMPTY[POSE]()
    message.pose.orientation.w = 0.0
    with pytest.raises(Unusable, match="its quaternion is zero"):
        CONVERSIONS["pose", POSE].read(message)


def test_it_is_known_what_a_packet_is_read_from():
    assert messages_of("ir") == [SCAN]
    assert messages_of("pose") == [POSE, ODOMETRY, POSE_COVARIANCE, TRANSFORM]


def written(packet, kind, body=None, moment=NOW):
    message = EMPTY[kind]()
    CONVERSIONS[packet, kind].write(message, body or BODIES[packet], moment, 0)
    return message


def test_what_a_reading_does_not_know_a_message_does_not_say():
    message = written("imu", IMU, Imu((0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
    assert (message.orientation_covariance[0], message.header.frame_id) == (-1.0, "map")
    assert CONVERSIONS["imu", IMU].read(message).orientation is None
    message = written("gps_fix", FIX, GpsFix(1.0, 2.0))
    assert math.isnan(message.altitude)
    assert message.position_covariance_type == 0
    read = CONVERSIONS["gps_fix", FIX].read(message)
    assert (read.altitude_m, read.horizontal_m, read.vertical_m) == (None, None, None)
    scan = written("laser_scan", SCAN)
    assert scan.ranges[0] == 1.0
    assert math.isnan(scan.ranges[1])
    assert scan.ranges[2] == math.inf


def test_a_quaternion_that_rounding_has_changed_is_taken():
    message = written("pose_3d", POSE)
    message.pose.orientation.w *= 1.04
    orientation = CONVERSIONS["pose_3d", POSE].read(message).orientation
    assert math.hypot(*orientation) == pytest.approx(1.0)


def test_below_the_least_range_a_scan_measured_nothing_and_minus_infinity_is_too_near():
    message = written("laser_scan", SCAN)
    message.range_min, message.ranges = 0.2, [0.1, -math.inf, 0.2, 99.0, math.nan]
    assert CONVERSIONS["laser_scan", SCAN].read(message).ranges_mm == (0, 1, 200, 4000, 0)


def changed(packet, kind, change):
    message = written(packet, kind)
    change(message)
    return message


@pytest.mark.parametrize(
    ("packet", "message", "told"),
    [
        ("encoders", changed("encoders", JOINTS, lambda it: setattr(it, "position", [])), "no joint says its position"),
        ("encoders", changed("encoders", JOINTS, lambda it: setattr(it, "velocity", [1.0])), "1 numbers for 2 wheels"),
        ("encoders", changed("encoders", JOINTS, lambda it: setattr(it, "position", [1.0, math.nan])), "not finite"),
        ("imu", changed("imu", IMU, lambda it: setattr(it.angular_velocity, "x", math.inf)), "not finite"),
        ("imu", changed("imu", IMU, lambda it: setattr(it, "angular_velocity_covariance", [-1.0])), "turning rate"),
        ("gps_fix", changed("gps_fix", FIX, lambda it: setattr(it.status, "status", -1)), "no fix"),
        ("gps_fix", changed("gps_fix", FIX, lambda it: setattr(it, "latitude", 91.0)), "no latitude"),
        ("gps_fix", changed("gps_fix", FIX, lambda it: setattr(it, "longitude", math.nan)), "not finite"),
        ("laser_scan", changed("laser_scan", SCAN, lambda it: setattr(it, "ranges", [])), "at least one ray"),
        ("laser_scan", changed("laser_scan", SCAN, lambda it: setattr(it, "range_max", math.inf)), "not finite"),
        ("laser_scan", changed("laser_scan", SCAN, lambda it: setattr(it, "range_max", 0.0)), "above 0"),
        ("camera", changed("camera", IMAGE, lambda it: setattr(it, "format", "png")), "only JPEG"),
        ("camera", changed("camera", IMAGE, lambda it: setattr(it, "data", b"GIF")), "not a JPEG"),
        (
            "camera",
            changed("camera", IMAGE, lambda it: setattr(it, "data", jpeg(9, 9, MOST_JPEG_BYTES))),
            f"at most {MOST_JPEG_BYTES}",
        ),
        ("pose_3d", changed("pose_3d", POSE, lambda it: setattr(it.header, "frame_id", "")), "does not name the frame"),
        ("pose_3d", changed("pose_3d", POSE, lambda it: setattr(it.header, "frame_id", "f" * 257)), "257 characters"),
        ("pose_3d", changed("pose_3d", POSE, lambda it: setattr(it.pose.orientation, "w", 3.0)), "length"),
        ("pose", changed("pose", TRANSFORM, lambda it: setattr(it, "child_frame_id", "map")), "has to name two frames"),
    ],
)
def test_a_message_of_a_sensor_that_says_no_reading_is_refused(packet, message, told):
    (kind,) = (it for it in (JOINTS, IMU, FIX, SCAN, IMAGE, TRANSFORM, POSE) if it in KIND_OF[packet])
    with pytest.raises(Unusable, match=told):
        CONVERSIONS[packet, kind].read(message)


KIND_OF = {
    "encoders": (JOINTS,),
    "imu": (IMU,),
    "gps_fix": (FIX,),
    "laser_scan": (SCAN,),
    "camera": (IMAGE,),
    "pose_3d": (POSE,),
    "pose": (TRANSFORM,),
}


def test_a_pose_is_a_transform_from_a_frame_to_that_of_the_body():
    (step,) = written("pose", TRANSFORMS).transforms
    assert (step.header.frame_id, step.child_frame_id) == ("map", "base_link")
    assert (step.transform.translation.x, step.transform.translation.y) == (1.5, -2.0)
    (step,) = written("pose_3d", TRANSFORMS).transforms
    assert (step.header.frame_id, step.child_frame_id, step.transform.translation.z) == ("odom", "base_link", 3.0)
    with pytest.raises(Unusable, match="to itself"):
        written("pose", TRANSFORM, moment=Moment(1, 2, "map", "map"))
