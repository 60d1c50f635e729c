"""Devices that every computer has: its own load, memory, temperature and battery (`host.*`).

They say what the operating system says, by psutil, on whatever system that knows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pancakes.bodies.devices.driver import Sensor
from pancakes.bodies.devices.levels import level_of
from pancakes.bodies.devices.types import Battery, Load, Memory, Temperature
from pancakes.errors import PancakesError
from pancakes.runtime.foundation.processors import processor_times

MOST_PERCENT: Final = 105.0
POWER_SUPPLIES: Final = Path("/sys/class/power_supply")
"""Where Linux tells the voltage of batteries, which psutil does not."""


class HostProcessorLoad(Sensor):
    """The share of all processor time in use since the reading before (`host.load`)."""

    type = "load"

    def open(self) -> None:
        self._busy_s, self._all_s = processor_times()

    def sample(self) -> Load:
        # Not `psutil.cpu_percent`: it compares with the call before in the same thread, and a pool has several.
        before = self._busy_s, self._all_s
        self._busy_s, self._all_s = processor_times()
        busy_s, all_s = self._busy_s - before[0], self._all_s - before[1]
        return Load(min(max(busy_s / all_s, 0.0), 1.0) if all_s > 0 else 0.0)


class HostMemory(Sensor):
    """The memory in use: what programs could not get if they asked for it (`host.memory`)."""

    type = "memory"

    def sample(self) -> Memory:
        import psutil

        memory = psutil.virtual_memory()
        return Memory(memory.total - memory.available, memory.total)


class HostTemperature(Sensor):
    """The temperature of the hottest sensor, or of one kind of sensors (`host.temperature`)."""

    type = "temperature"
    blocking = True  # some of these sensors sit on slow buses

    @dataclass
    class Settings:
        """Which sensors are asked.

        Attributes:
            chip: name of the chip that has them, such as `coretemp` or `cpu_thermal`; empty: all.
        """

        chip: str = ""

    settings: Settings

    def open(self) -> None:
        chips = _temperatures()
        if not chips:
            raise PancakesError("this computer has no temperature sensor that its operating system tells of")
        if self.settings.chip and self.settings.chip not in chips:
            raise PancakesError(
                f"this computer has no temperature sensor {self.settings.chip!r}, only {', '.join(sorted(chips))}"
            )

    def sample(self) -> Temperature:
        chips = _temperatures()
        wanted = [self.settings.chip] if self.settings.chip else list(chips)
        celsius = [value for chip in wanted for value in chips.get(chip, [])]
        if not celsius:
            raise PancakesError("no temperature sensor of this computer answers")
        return Temperature(max(celsius))


class HostBattery(Sensor):
    """The battery of a laptop (`host.battery`). Its voltage is NaN where the system does not tell it."""

    type = "battery"
    blocking = True  # asking may go through the firmware

    def open(self) -> None:
        if _battery_share() is None:
            raise PancakesError("this computer has no battery that its operating system tells of")

    def sample(self) -> Battery:
        share = _battery_share()
        if share is None:
            raise PancakesError("the operating system tells of no battery any more")
        return Battery(_battery_voltage_v(), share)


def _temperatures() -> dict[str, list[float]]:
    """Returns what all temperature sensors say, by the chip they sit on."""
    import psutil

    ask = getattr(psutil, "sensors_temperatures", None)  # not on every system
    if ask is None:
        return {}
    # A sensor without a value says NaN, or nothing at all; `max` would lose a NaN, or return it.
    chips = {
        chip: [entry.current for entry in entries if entry.current is not None and math.isfinite(entry.current)]
        for chip, entries in ask().items()
    }
    return {chip: values for chip, values in chips.items() if values}


def _battery_share() -> float | None:
    import psutil

    ask = getattr(psutil, "sensors_battery", None)  # not on every system
    battery = ask() if ask is not None else None
    if battery is None:
        return None
    percent = battery.percent
    # Linux reckons with the charge that was full last, so a little more may be left: it is full then.
    return 1.0 if 100.0 < percent <= MOST_PERCENT else level_of(percent, 100.0)


def _battery_voltage_v() -> float:
    for path in sorted(POWER_SUPPLIES.glob("BAT*/voltage_now")):
        try:
            return int(path.read_text()) / 1e6
        except (OSError, ValueError):
            continue
    return math.nan
