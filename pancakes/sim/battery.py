"""A simulated battery, which is drained by what a robot does.

Energy empties it, not time: rolling wheels, each reading of each kind of sensor, each mission packet that the agent
sends to another, a radio that listens, and what the electronics always take. So a robot that senses or sends less
often, drives less far, or lets its Network Service sleep lasts longer; its tasks can decide that (paper §3.4, §4). Each
of these is counted separately.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from pancakes.settings import NotNegative, Positive, Share
from pancakes.sim.world_state import Spent

DEFAULT_SAMPLE_J: Final = {"ir": 0.01, "sonar": 0.03, "pose": 0.0, "battery": 0.0, "motion": 0.01, "laser_scan": 0.25}


@dataclass
class BatterySettings:
    """The charge of a battery, and its consumers.

    Attributes:
        capacity_j: energy between full and empty. The default, a Khepera III's pack, lasts for hours.
        level: how full it is at the start, 0 to 1.
        idle_w: the constant power of the electronics.
        motion_j_per_m: energy for each metre that a wheel rolls; both wheels count.
        sample_j: energy for one reading, by the type of the device; other types take nothing.
        packet_j: energy for one mission packet sent to another agent.
        listen_w: the power of the radio while the agent's Network Service is awake. Each request for the battery
            reports whether it is.
        noise_v: standard deviation of the measured voltage.
        charges: whether it takes energy from a dock; false: a defective one, which tells that it is being charged.
    """

    capacity_j: Positive = 36_000.0
    level: Share = 1.0
    idle_w: NotNegative = 0.6
    motion_j_per_m: NotNegative = 4.0
    sample_j: dict[str, NotNegative] = field(default_factory=lambda: dict(DEFAULT_SAMPLE_J))
    packet_j: NotNegative = 0.01
    listen_w: NotNegative = 0.0
    noise_v: NotNegative = 0.001
    charges: bool = True


class BatteryModel:
    """The charge of one battery.

    Args:
        settings: its charge, and its consumers.
        full_v: voltage when full.
        empty_v: voltage when empty; in between, the voltage follows the charge in a straight line.

    Attributes:
        listening: whether the radio listens.
        charging: whether a dock charges it now.
    """

    def __init__(self, settings: BatterySettings, full_v: float, empty_v: float) -> None:
        self._settings = settings
        self._full_v = full_v
        self._empty_v = empty_v
        self._charge_j = settings.capacity_j * settings.level
        self._packets = 0
        self._idle_j = self._motion_j = self._sensing_j = self._listening_j = self._sending_j = 0.0
        self.listening = True
        self.charging = False

    @property
    def level(self) -> float:
        """Its charge, from 0 (empty) to 1 (full)."""
        return self._charge_j / self._settings.capacity_j

    @property
    def voltage_v(self) -> float:
        """The true voltage at its terminals."""
        return self._empty_v + self.level * (self._full_v - self._empty_v)

    @property
    def empty(self) -> bool:
        """Whether it is empty: the motors get no more power."""
        return self._charge_j <= 0.0

    def level_at(self, voltage_v: float) -> float:
        """Return the level for a measured voltage, clamped to 0 to 1, because noise may exceed that."""
        return min(max((voltage_v - self._empty_v) / (self._full_v - self._empty_v), 0.0), 1.0)

    def passed(self, elapsed_s: float, rolled_m: float) -> None:
        """Drain it for a time in which the wheels rolled `rolled_m` in all (both wheels, either way)."""
        self._idle_j += self._take(self._settings.idle_w * elapsed_s)
        self._motion_j += self._take(self._settings.motion_j_per_m * rolled_m)
        if self.listening:
            self._listening_j += self._take(self._settings.listen_w * elapsed_s)

    def charged(self, energy_j: float) -> None:
        """Take energy of a dock, as far as there is room for it; a defective battery takes none."""
        if self._settings.charges:
            self._charge_j = min(self._charge_j + energy_j, self._settings.capacity_j)

    def sampled(self, device_type: str) -> None:
        """Count a reading of a sensor of this type."""
        self._sensing_j += self._take(self._settings.sample_j.get(device_type, 0.0))

    def packets_sent(self, total: int) -> None:
        """Take the agent's total of mission packets; fewer than before means that a new agent counts."""
        new = total - self._packets if total >= self._packets else total
        self._packets = total
        self._sending_j += self._take(self._settings.packet_j * new)

    @property
    def spent(self) -> Spent:
        """The energy that it has given so far, by use."""
        return Spent(self._idle_j, self._motion_j, self._sensing_j, self._listening_j, self._sending_j)

    def _take(self, energy_j: float) -> float:
        """Take energy, as far as there is any; return how much was taken."""
        taken_j = energy_j if energy_j < self._charge_j else self._charge_j
        self._charge_j -= taken_j
        return taken_j
