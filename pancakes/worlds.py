"""What a simulator of your own is written against: worlds, their contents, their devices, and robot models.

`SimulatedWorld` is the task that owns the simulator. `SimulatedSensor` and `SimulatedActuator` are the drivers of its
devices. A `RobotModel` is what a configuration names as `model = "..."`; another distribution brings one by the entry
point group `pancakes.robot_models`.
"""

from __future__ import annotations

from pancakes.sim.battery import BatteryModel, BatterySettings
from pancakes.sim.bodies import (
    ArenaSettings,
    Disc,
    MotionSettings,
    RobotSettings,
    SensorSettings,
    WorldSettings,
    sensed_motion,
)
from pancakes.sim.docks import Charged, Docks, DockSettings, check_docks
from pancakes.sim.drivers import DifferentialDrive, SimulatedActuator, SimulatedPose, SimulatedSensor
from pancakes.sim.rays import Fan
from pancakes.sim.robot_models import (
    DriveKinematics,
    IrCurve,
    IrRing,
    LaserScanner,
    RangeSensor,
    RobotModel,
    SonarRing,
    WheelEncoders,
    Wheels,
    robot_model,
)
from pancakes.sim.simulated_world import SimulatedWorld
from pancakes.sim.world_state import BodyState, Spent, WorldState

__all__ = [
    "ArenaSettings",
    "BatteryModel",
    "BatterySettings",
    "BodyState",
    "Charged",
    "DifferentialDrive",
    "Disc",
    "DockSettings",
    "Docks",
    "DriveKinematics",
    "Fan",
    "IrCurve",
    "IrRing",
    "LaserScanner",
    "MotionSettings",
    "RangeSensor",
    "RobotModel",
    "RobotSettings",
    "SensorSettings",
    "SimulatedActuator",
    "SimulatedPose",
    "SimulatedSensor",
    "SimulatedWorld",
    "SonarRing",
    "Spent",
    "WheelEncoders",
    "Wheels",
    "WorldSettings",
    "WorldState",
    "check_docks",
    "robot_model",
    "sensed_motion",
]
