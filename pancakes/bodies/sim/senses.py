"""What the sensors of simulated bodies say, with the noise of real ones."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from functools import cache

from pancakes.bodies.devices.types import Battery, Infrared, Motion, Sonar
from pancakes.bodies.sim.arena import Arena
from pancakes.bodies.sim.body import Robot, SensorNode
from pancakes.bodies.sim.disc import Disc
from pancakes.bodies.sim.rays import Fan
from pancakes.bodies.sim.robot import IrRing, SonarRing
from pancakes.bodies.sim.settings import NoiseSettings

_IR_RAYS = 3
_SONAR_RAYS = 5
_IR_MAX_RAW = 4095  # its converter has 12 bits


@cache
def _fan(ring: IrRing | SonarRing, rays: int, limit_m: float) -> Fan:
    return Fan(ring.sensors, ring.cone_rad, rays, limit_m)


class Senses:
    """Reads the sensors of the bodies in an arena, at the moment they are asked.

    Args:
        arena: where the bodies are.
        noise: how far the sensors are off.
        random: draws the noise, and nothing else.
    """

    def __init__(self, arena: Arena, noise: NoiseSettings, random: random.Random) -> None:
        self._arena = arena
        self._noise = noise
        self._normal = random.gauss

    def battery(self, robot: Robot, noise_v: float) -> Battery:
        """Measures a robot's battery."""
        voltage_v = robot.battery.voltage_v + noise_v * self._normal()
        return Battery(voltage_v, robot.battery.level_at(voltage_v))

    def infrared(self, robot: Robot) -> Infrared:
        """Asks a robot's infrared ring. Distances come from the raw values, noise and rounding included.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.infrared_ring()
        normal, curve = self._normal, ring.curve
        ir_share, ir_raw = self._noise.ir_share, self._noise.ir_raw
        fan = _fan(ring, _IR_RAYS, curve.farthest_m)
        raw = []
        for distance_m in self._arena.ranges(robot.disc, fan):
            noisy = ir_raw * normal()
            if distance_m < math.inf:
                noisy += curve.raw(distance_m) * (1.0 + ir_share * normal())
            raw.append(round(noisy) if 0.0 < noisy < _IR_MAX_RAW else 0 if noisy < 1.0 else _IR_MAX_RAW)
        return Infrared(fan.bearings_rad, tuple(map(curve.distance, raw)), curve.farthest_m, tuple(raw))

    def sonar(self, robot: Robot) -> Sonar:
        """Asks a robot's sonar ring.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.sonar_ring()
        limit_m, sonar_m, normal = ring.max_range_m, self._noise.sonar_m, self._normal
        fan = _fan(ring, _SONAR_RAYS, limit_m)
        ranges_m = []
        for distance_m in self._arena.ranges(robot.disc, fan):
            if distance_m < math.inf:
                distance_m += sonar_m * normal()
            ranges_m.append(0.0 if distance_m < 0.0 else distance_m if distance_m < limit_m else limit_m)
        return Sonar(fan.bearings_rad, tuple(ranges_m), limit_m)

    def motion(self, sensor: SensorNode, discs: Sequence[Disc]) -> Motion:
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
        range_m = nearest[0] + settings.range_noise_m * self._normal()
        bearing_rad = nearest[1] + settings.bearing_noise_rad * self._normal()
        return Motion(True, math.remainder(bearing_rad, math.tau), max(range_m, 0.0))
