"""What the sensors of simulated bodies say, with the noise of real ones."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from pancakes.devices.types import Battery, Infrared, Motion, Sonar
from pancakes.sim.arena import Arena, Disc
from pancakes.sim.body import Robot, Sensor
from pancakes.sim.settings import NoiseSettings

_IR_RAYS = 3
_SONAR_RAYS = 5
_IR_MAX_RAW = 4095  # its converter has 12 bits


class Senses:
    """Reads the sensors of the bodies in an arena, at the moment they are asked.

    Args:
        arena: where the bodies are.
        noise: how far the sensors are off.
        random: draws the noise.
    """

    def __init__(self, arena: Arena, noise: NoiseSettings, random: random.Random) -> None:
        self._arena = arena
        self._noise = noise
        self._random = random

    def battery(self, robot: Robot, noise_v: float) -> Battery:
        """Measures a robot's battery."""
        voltage_v = robot.battery.voltage_v + noise_v * self._random.gauss(0.0, 1.0)
        return Battery(voltage_v, robot.battery.level_at(voltage_v))

    def infrared(self, robot: Robot) -> Infrared:
        """Asks a robot's infrared ring. Distances come from the raw values, noise and rounding included.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.infrared_ring()
        gauss, curve = self._random.gauss, ring.curve
        raw = []
        for distance_m in self._arena.ranges(robot.disc, ring.sensors, ring.cone_rad, _IR_RAYS, curve.farthest_m):
            share = 1.0 + self._noise.ir_share * gauss(0.0, 1.0)
            noisy = curve.raw(distance_m) * share + self._noise.ir_raw * gauss(0.0, 1.0)
            raw.append(min(max(round(noisy), 0), _IR_MAX_RAW))
        bearings = tuple(sensor.bearing_rad for sensor in ring.sensors)
        return Infrared(bearings, tuple(curve.distance(value) for value in raw), curve.farthest_m, tuple(raw))

    def sonar(self, robot: Robot) -> Sonar:
        """Asks a robot's sonar ring.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.sonar_ring()
        limit_m = ring.max_range_m
        ranges_m = []
        for distance_m in self._arena.ranges(robot.disc, ring.sensors, ring.cone_rad, _SONAR_RAYS, limit_m):
            if math.isfinite(distance_m):
                distance_m += self._noise.sonar_m * self._random.gauss(0.0, 1.0)
            ranges_m.append(min(max(distance_m, 0.0), limit_m))
        return Sonar(tuple(sensor.bearing_rad for sensor in ring.sensors), tuple(ranges_m), limit_m)

    def motion(self, sensor: Sensor, discs: Sequence[Disc]) -> Motion:
        """Asks a motion sensor which of some discs move where it looks.

        Returns:
            Whether there is one; where the nearest is, if the sensor can tell.
        """
        settings = sensor.motion
        x_m, y_m = sensor.disc.position
        nearest: tuple[float, float] | None = None
        for disc in discs:
            if math.hypot(*disc.velocity) < settings.least_speed_mps:
                continue
            dx_m, dy_m = disc.position[0] - x_m, disc.position[1] - y_m
            range_m = math.hypot(dx_m, dy_m)
            bearing_rad = math.remainder(math.atan2(dy_m, dx_m) - sensor.disc.theta_rad, math.tau)
            seen = range_m <= settings.range_m and abs(bearing_rad) <= 0.5 * settings.field_of_view_rad
            if seen and (nearest is None or range_m < nearest[0]):
                nearest = (range_m, bearing_rad)
        if nearest is None or not settings.locates:
            return Motion(nearest is not None)
        range_m = nearest[0] + settings.range_noise_m * self._random.gauss(0.0, 1.0)
        bearing_rad = nearest[1] + settings.bearing_noise_rad * self._random.gauss(0.0, 1.0)
        return Motion(True, math.remainder(bearing_rad, math.tau), max(range_m, 0.0))
