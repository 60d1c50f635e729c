"""Devices without hardware: those that do nothing, and those that never change."""

import math

import pytest
from devices.driver_context import DriverContext

from pancakes.devices import Pose, Twist, builtin_drivers
from pancakes.devices.builtin_drivers import StaticPose
from pancakes.devices.driver import Sensor
from pancakes.settings import SettingsError, make_settings


@pytest.mark.parametrize(
    ("cls", "device_type"),
    [
        (builtin_drivers.NullPose, "pose"),
        (builtin_drivers.NullBattery, "battery"),
        (builtin_drivers.NullInfrared, "ir"),
        (builtin_drivers.NullSonar, "sonar"),
        (builtin_drivers.NullMotion, "motion"),
    ],
)
def test_a_null_sensor_has_its_type_and_never_a_reading(cls, device_type):
    sensor = cls(DriverContext(), cls.Settings())
    sensor.open()
    assert cls.type == device_type
    assert sensor.read() is None
    sensor.close()


def test_null_motors_take_every_command():
    motors = builtin_drivers.NullMotors(DriverContext(), builtin_drivers.NullMotors.Settings())
    motors.open()
    motors.write(Twist(0.1, 0.0), 0.5, "agent1/client/ScanTarget")
    motors.safe_stop()
    motors.close()
    assert motors.type == "motors"


def test_a_null_device_of_ones_own_type_is_a_class_of_two_lines():
    class NullGas(builtin_drivers.NullSensor):
        type = "gas"

    gas: Sensor = NullGas(DriverContext(), NullGas.Settings())
    assert gas.read() is None


def test_a_static_pose_is_where_it_was_said_to_be():
    settings = make_settings(StaticPose.Settings, {"x_m": 1.0, "y_m": -2.0, "theta_rad": 3 * math.pi})
    assert StaticPose(DriverContext(), settings).read() == Pose(1.0, -2.0, pytest.approx(math.pi))


def test_a_static_pose_must_be_said():
    with pytest.raises(SettingsError, match="x_m: is missing; y_m: is missing"):
        make_settings(StaticPose.Settings, {})
