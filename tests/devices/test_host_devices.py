"""The devices of the computer itself, as its operating system tells them."""

import math
from types import SimpleNamespace
from typing import NamedTuple

import psutil
import pytest

from pancakes.devices import builtin_drivers
from pancakes.errors import PancakesError


def opened(cls, **settings):
    driver = cls(None, cls.Settings(**settings))
    driver.open()
    return driver


def test_load_is_a_share():
    reading = opened(builtin_drivers.HostProcessorLoad).read()
    assert 0.0 <= reading.cpu <= 1.0


class SimpleTimes(NamedTuple):
    """The processor times of a system that tells no more than these."""

    user: float
    idle: float


def test_load_is_what_the_system_says(monkeypatch):
    readings = iter([SimpleTimes(10.0, 90.0), SimpleTimes(13.0, 95.0)])
    monkeypatch.setattr(psutil, "cpu_times", lambda: next(readings))
    assert opened(builtin_drivers.HostProcessorLoad).read().cpu == 0.375


def test_memory_in_use_is_part_of_all_memory():
    reading = opened(builtin_drivers.HostMemory).read()
    assert 0 < reading.used_bytes < reading.total_bytes == psutil.virtual_memory().total


def temperatures(monkeypatch, chips):
    entries = {chip: [SimpleNamespace(current=value) for value in values] for chip, values in chips.items()}
    monkeypatch.setattr(psutil, "sensors_temperatures", lambda: entries, raising=False)


def test_the_hottest_sensor_counts(monkeypatch):
    temperatures(monkeypatch, {"coretemp": [41.0, 55.0], "nvme": [38.0]})
    assert opened(builtin_drivers.HostTemperature).read().celsius == 55.0
    assert opened(builtin_drivers.HostTemperature, chip="nvme").read().celsius == 38.0


def test_a_computer_without_a_temperature_says_so(monkeypatch):
    temperatures(monkeypatch, {})
    with pytest.raises(PancakesError, match="this computer has no temperature sensor that its operating system tells"):
        opened(builtin_drivers.HostTemperature)
    monkeypatch.delattr(psutil, "sensors_temperatures")  # as on macOS and Windows
    with pytest.raises(PancakesError, match="no temperature sensor"):
        opened(builtin_drivers.HostTemperature)


def test_a_chip_that_is_not_there_is_named_with_those_that_are(monkeypatch):
    temperatures(monkeypatch, {"coretemp": [41.0], "nvme": [38.0]})
    with pytest.raises(PancakesError, match="no temperature sensor 'cpu_thermal', only coretemp, nvme"):
        opened(builtin_drivers.HostTemperature, chip="cpu_thermal")


def test_a_battery_has_its_level_and_the_voltage_that_linux_tells(monkeypatch, tmp_path):
    monkeypatch.setattr(psutil, "sensors_battery", lambda: SimpleNamespace(percent=82.0), raising=False)
    monkeypatch.setattr(builtin_drivers, "POWER_SUPPLIES", tmp_path)
    (tmp_path / "BAT0").mkdir()
    (tmp_path / "BAT0" / "voltage_now").write_text("11850000\n")
    reading = opened(builtin_drivers.HostBattery).read()
    assert (reading.level, reading.voltage_v) == (pytest.approx(0.82), pytest.approx(11.85))


def test_a_battery_whose_voltage_nobody_tells_has_none(monkeypatch, tmp_path):
    monkeypatch.setattr(psutil, "sensors_battery", lambda: SimpleNamespace(percent=82.0), raising=False)
    monkeypatch.setattr(builtin_drivers, "POWER_SUPPLIES", tmp_path)
    assert math.isnan(opened(builtin_drivers.HostBattery).read().voltage_v)


def test_a_computer_without_a_battery_says_so(monkeypatch):
    monkeypatch.setattr(psutil, "sensors_battery", lambda: None, raising=False)
    with pytest.raises(PancakesError, match="this computer has no battery that its operating system tells of"):
        opened(builtin_drivers.HostBattery)
