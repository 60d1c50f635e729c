"""The bodies of a simulated world: a robot with its wheels and battery, a sensor node, a walking person."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pancakes.bodies.sim.battery import BatteryModel
from pancakes.bodies.sim.disc import Disc
from pancakes.bodies.sim.drive import Wheels
from pancakes.bodies.sim.robot import IrRing, RobotModel, SonarRing
from pancakes.bodies.sim.settings import MotionSettings
from pancakes.bodies.sim.wayfinder import MoverSettings, Obstacle, Wayfinder
from pancakes.errors import PancakesError


class Robot:
    """A robot's wheels and battery, and the body they move.

    The wheels follow the newest command for as long as it is good, then they stand: the safe hold that still
    works where the robot's agent is dead.

    Args:
        model: see below.
        disc: likewise.
        battery: likewise.
        wheel_noise: by which share of its speed a wheel is off, as a standard deviation.
        normal: draws the noise, of mean 0 and deviation 1.

    Attributes:
        model: what kind of robot it is.
        disc: its body.
        battery: its battery.
        driven_by: the task whose command the wheels follow now; empty in safe hold.
    """

    def __init__(
        self, model: RobotModel, disc: Disc, battery: BatteryModel, wheel_noise: float, normal: Callable[[], float]
    ) -> None:
        self.model = model
        self.disc = disc
        self.battery = battery
        self._wheel_noise = wheel_noise
        self._normal = normal
        self._good_until_s = math.inf
        self._rolling_mps = 0.0
        self.driven_by = ""
        self._rolled_m = 0.0

    def infrared_ring(self) -> IrRing:
        """Returns its infrared ring.

        Raises:
            PancakesError: robots of its kind have none.
        """
        if self.model.ir is None:
            raise PancakesError(f"{self.disc.name} is a {self.model.name}, which has no infrared sensors")
        return self.model.ir

    def sonar_ring(self) -> SonarRing:
        """Returns its sonar ring.

        Raises:
            PancakesError: robots of its kind have none.
        """
        if self.model.sonar is None:
            raise PancakesError(f"{self.disc.name} is a {self.model.name}, which has no sonars")
        return self.model.sonar

    def drive(self, wheels: Wheels, until_s: float, source: str) -> None:
        """Follows a command.

        Args:
            wheels: how fast both wheels are to run.
            until_s: mission time until which the command is good.
            source: address of the task that gave it.
        """
        if self.battery.empty:
            return
        asked = self.model.drive.carried_out(wheels)
        left_mps = asked.left_mps * (1.0 + self._wheel_noise * self._normal())
        right_mps = asked.right_mps * (1.0 + self._wheel_noise * self._normal())
        done = self.model.drive.carried_out(Wheels(left_mps, right_mps))
        twist = self.model.drive.twist(done)
        self.disc.roll(twist.v_mps, twist.omega_radps)
        self._rolling_mps = abs(done.left_mps) + abs(done.right_mps)
        self._good_until_s = until_s
        self.driven_by = source.rpartition("/")[2]

    def hold(self) -> None:
        """Stands still."""
        self.disc.roll(0.0, 0.0)
        self._rolling_mps = 0.0
        self._good_until_s = math.inf
        self.driven_by = ""

    def before_step(self, time_s: float) -> float:
        """A step begins at `time_s`. Returns when its command ceases to be good; infinity where it has none."""
        if self._good_until_s <= time_s:
            self.hold()
        return self._good_until_s

    def rolls(self, steps: int, dt_s: float) -> None:
        """Its wheels roll for so many steps."""
        if self._rolling_mps:
            for _ in range(steps):
                self._rolled_m += self._rolling_mps * dt_s

    def settle(self, elapsed_s: float) -> None:
        """Takes from the battery what the last `elapsed_s` cost."""
        self.battery.passed(elapsed_s, self._rolled_m)
        self._rolled_m = 0.0
        if self.battery.empty:
            self.hold()


@dataclass
class SensorNode:
    """A sensor node: a body that stands, with a motion sensor."""

    disc: Disc
    motion: MotionSettings


@dataclass
class Walker:
    """A walking person.

    Attributes:
        disc: the body.
        wayfinder: decides where it goes.
        settings: how it walks.
        standing: the obstacles that never move.
    """

    disc: Disc
    wayfinder: Wayfinder
    settings: MoverSettings
    standing: Sequence[Obstacle]
