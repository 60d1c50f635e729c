"""Virtual devices: the hardware is another agent's, the packets come over the mesh."""

import pytest
from devices.driver_context import DriverContext

from pancakes.control import Hold
from pancakes.devices import Battery, Pose, Twist
from pancakes.devices.builtin_drivers import NetworkMotors, NetworkPose
from pancakes.devices.driver import Pace
from pancakes.packet import Packet, type_name
from pancakes.settings import SettingsError, make_settings


def packet(body, source="world/client/MotionCapture"):
    return Packet("system", type_name(body), source, "agent1/device/pose", 0.0, 1, body)


def pose_device(**settings):
    context = DriverContext()
    driver = NetworkPose(context, make_settings(NetworkPose.Settings, settings))
    driver.open()
    return driver, context


def test_a_reading_that_comes_is_published_as_its_own():
    driver, context = pose_device()
    driver.receive(packet(Pose(1.0, 2.0, 0.5)))
    assert context.readings == [Pose(1.0, 2.0, 0.5)]
    assert driver.read() is None


def test_no_more_than_max_hz_are_published():
    driver, context = pose_device(max_hz=10.0)
    for step in range(200):  # 100 a second for 2 s
        context.run_until(step * 0.01)
        driver.receive(packet(Pose(step, 0.0, 0.0)))
    assert len(context.readings) == pytest.approx(20, abs=1)


def test_readings_at_the_same_rate_all_pass_though_they_are_not_quite_regular():
    driver, context = pose_device(max_hz=10.0)
    for step in range(100):
        context.run_until(0.1 * step + (0.008 if step % 2 else 0.0))
        driver.receive(packet(Pose(step, 0.0, 0.0)))
    assert len(context.readings) == 100


def test_packets_of_another_type_are_dropped_and_said_once():
    driver, context = pose_device()
    for _ in range(3):
        driver.receive(packet(Battery(8.0, 0.5), "agent2/device/battery"))
    assert context.readings == []
    assert context.lines == [
        ("warning", "this device takes packets of the type 'pose'; agent2/device/battery sent 'battery'")
    ]


def test_a_reading_that_is_left_out_is_a_sign_of_life():
    driver, context = pose_device(max_hz=0.1)
    for time_s in (1.0, 2.0):
        context.run_until(time_s)
        driver.receive(packet(Pose(0.0, 0.0, 0.0)))
    assert (len(context.readings), context.alive_s) == (1, [2.0])


def test_virtual_devices_say_that_they_need_the_mesh():
    assert NetworkPose.networked
    assert NetworkMotors.networked


def test_virtual_motors_pass_commands_and_hold_on():
    context = DriverContext()
    motors = NetworkMotors(context, make_settings(NetworkMotors.Settings, {"target": "agent2/device/motors"}))
    motors.open()
    motors.write(Twist(0.1, 0.2), 0.5, "agent1/client/ScanTarget")
    motors.safe_stop()
    (first, second) = context.sent
    assert first == ("ctrl", Twist(0.1, 0.2), "agent2/device/motors")
    assert (second[0], type(second[1]), second[2]) == ("ctrl", Hold, "agent2/device/motors")


@pytest.mark.parametrize("target", ["agent2", "agent2/motors", "agent2//motors", ""])
def test_a_target_must_be_a_devices_address(target):
    with pytest.raises(SettingsError, match="no device's address"):
        make_settings(NetworkMotors.Settings, {"target": target})


def test_a_pace_does_not_make_up_for_a_gap():
    pace = Pace(10.0)
    assert pace.due(0.0)
    assert pace.due(5.0)
    assert not pace.due(5.01)
    assert pace.due(5.1)
