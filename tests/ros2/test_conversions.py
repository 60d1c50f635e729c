"""What packets and messages become of each other. These tests need no ROS 2: a message is what has its fields."""

import math
from types import SimpleNamespace

import pytest
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

from pancakes.devices import Battery, Infrared, Motion, Pose, Sonar, Temperature, Twist

NOW = Moment(12, 34, "map")


def space(**fields):
    return SimpleNamespace(**fields)


def header():
    return space(stamp=space(sec=0, nanosec=0), frame_id="")


def pose():
    return space(position=space(x=0.0, y=0.0, z=0.0), orientation=space(x=0.0, y=0.0, z=0.0, w=1.0))


def twist():
    return space(linear=space(x=0.0, y=0.0, z=0.0), angular=space(x=0.0, y=0.0, z=0.0))


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
}
BODIES = {
    "pose": Pose(1.5, -2.0, 3.0),
    "motors": Twist(0.25, -0.5),
    "battery": Battery(12.5, 0.75),
    "ir": Infrared((-0.5, 0.0, 0.5), (0.1, 0.3, 0.2), 0.3),
    "sonar": Sonar((-0.5, 0.0, 0.5), (1.0, 4.0, 2.0), 4.0),
    "motion": Motion(True),
    "temperature": Temperature(21.5),
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
        assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == NOW


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
    assert messages_of("pose") == [POSE, ODOMETRY, POSE_COVARIANCE]
