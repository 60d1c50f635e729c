"""Chips on buses: register bytes against their datasheets, and the real bus where the kernel has a stub of one."""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import smbus2
from pancakes_pi.buses import BusBattery, BusTemperature
from pancakes_pi.one_wire import OneWireTemperature, celsius_in
from pancakes_pi.registers import THERMOMETERS, VOLTMETERS

from pancakes.control import Describe
from pancakes.devices import Battery, Temperature
from pancakes.settings import check_settings
from pancakes.testing import threaded_agent


@pytest.mark.parametrize(
    ("model", "word", "celsius"),
    [
        # NXP LM75A, table 8.
        ("lm75", 0x7F00, 127.0),
        ("lm75", 0x7EE0, 126.875),
        ("lm75", 0x1900, 25.0),
        ("lm75", 0x0020, 0.125),
        ("lm75", 0x0000, 0.0),
        ("lm75", 0xFFE0, -0.125),
        ("lm75", 0xE700, -25.0),
        ("lm75", 0xC900, -55.0),
        # TI TMP102, table 5.
        ("tmp102", 0x7FF0, 127.9375),
        ("tmp102", 0x6400, 100.0),
        ("tmp102", 0x1900, 25.0),
        ("tmp102", 0x0040, 0.25),
        ("tmp102", 0xFFC0, -0.25),
        ("tmp102", 0xE700, -25.0),
        ("tmp102", 0xC900, -55.0),
        # Microchip MCP9808, 5.2.3.1, with and without its flags.
        ("mcp9808", 0xC194, 25.25),
        ("mcp9808", 0x0194, 25.25),
        ("mcp9808", 0x1E6C, -25.25),
        ("mcp9808", 0x0000, 0.0),
    ],
)
def test_a_word_of_a_thermometer_means_what_its_datasheet_says(model: str, word: int, celsius: float) -> None:
    assert THERMOMETERS[model].value(word) == celsius


def test_a_word_of_a_voltmeter_means_what_its_datasheet_says() -> None:
    # TI INA219, 8.6.3.2: 2.992 V is 0x1760 with the flags at 0 and 5.984 V 0x2EC0; the flags do not count.
    assert VOLTMETERS["ina219"].value(0x1760) == pytest.approx(2.992)
    assert VOLTMETERS["ina219"].value(0x2EC2) == pytest.approx(5.984)


class BusInMemory:
    """Stands for the bus, behind the one method of smbus2 that the drivers call."""

    words: dict[tuple[int, int], int] = {}

    def __init__(self, bus: int) -> None:
        if bus != 1:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        word = self.words.get((address, register))
        if word is None:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        return list(word.to_bytes(length, "big"))

    def close(self) -> None:
        """Nothing is open."""


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[int, int], int]]:
    monkeypatch.setattr(smbus2, "SMBus", BusInMemory)
    BusInMemory.words = {}
    yield BusInMemory.words


def device(cls: type, **settings: Any) -> dict[str, Any]:
    return {"chip": {"type": cls, "rate_hz": 20, "settings": settings, "restart": {"pause_s": 0.05}}}


def test_a_chip_is_read(bus: dict[tuple[int, int], int]) -> None:
    bus[0x4A, 0] = 0x1900
    with threaded_agent("a", devices=device(BusTemperature, model="tmp102", address=0x4A)) as agent:
        assert agent.wait_for(Temperature).body.celsius == 25.0


def test_the_level_of_a_battery_is_told_by_its_voltage(bus: dict[tuple[int, int], int]) -> None:
    bus[0x40, 2] = round(7.2 / 0.004) << 3
    with threaded_agent("a", devices=device(BusBattery, full_v=8.4, empty_v=6.0)) as agent:
        body = agent.wait_for(Battery).body
        assert (body.voltage_v, body.level) == (pytest.approx(7.2), pytest.approx(0.5))


def test_one_read_in_thirty_that_fails_costs_one_reading(
    bus: dict[tuple[int, int], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus[0x48, 0] = 0x1900
    read, asked = BusInMemory.read_i2c_block_data, itertools.count(1)

    def read_or_fail(self: BusInMemory, address: int, register: int, length: int) -> list[int]:
        if next(asked) % 30 == 0:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        return read(self, address, register, length)

    monkeypatch.setattr(BusInMemory, "read_i2c_block_data", read_or_fail)
    chip = {**device(BusTemperature, model="lm75")["chip"], "rate_hz": 100}
    with threaded_agent("a", devices={"chip": chip}) as agent:
        agent.wait_until(lambda: len(agent.probe.packets(Temperature)) >= 100)
        assert not agent.events("task_failed")
        assert agent.ask(Describe("chip")).result["readings"]["missed"] >= 3
        assert any("chip: a reading is missed: no chip answers at 0x48" in line for line in agent.lines("warning"))


@pytest.mark.parametrize(("volts", "sentence"), [(12.6, "correct full_v"), (0.4, "is the battery connected?")])
def test_a_voltage_that_the_battery_cannot_have_is_no_level(
    bus: dict[tuple[int, int], int], volts: float, sentence: str
) -> None:
    bus[0x40, 2] = round(volts / 0.004) << 3
    with threaded_agent("a", devices=device(BusBattery, full_v=8.4, empty_v=6.0)) as agent:
        assert sentence in agent.wait_for_event("task_failed", task="chip")["error"]
        assert not agent.probe.packets(Battery)


def test_a_chip_that_comes_up_later_is_found(bus: dict[tuple[int, int], int]) -> None:
    with threaded_agent("a", devices=device(BusTemperature, model="lm75")) as agent:
        error = agent.wait_for_event("task_failed", task="chip")["error"]
        assert "no chip answers at 0x48 on /dev/i2c-1 (Remote I/O error): look with i2cdetect" in error
        bus[0x48, 0] = 0xE700
        assert agent.wait_for(Temperature).body.celsius == -25.0
        del bus[0x48, 0]
        agent.wait_until(lambda: len(agent.events("task_failed")) >= 2)
        agent.probe.forget()
        bus[0x48, 0] = 0x1900
        assert agent.wait_for(Temperature).body.celsius == 25.0


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"model": "lm75", "bus": 7}, "the bus /dev/i2c-7 cannot be opened (No such file or directory)"),
        ({"model": "mcp9808", "address": 0x48}, "address = 0x48: this chip is at 0x18 to 0x1f"),
    ],
)
def test_what_cannot_be_is_named(bus: dict[tuple[int, int], int], settings: dict[str, Any], problem: str) -> None:
    with threaded_agent("a", devices=device(BusTemperature, **settings)) as agent:
        assert problem in agent.wait_for_event("task_failed", task="chip")["error"]


def test_settings_that_make_no_sense_are_named() -> None:
    assert "empty_v is 9 V, not below full_v" in str(
        check_settings(BusBattery.Settings, {"full_v": 8, "empty_v": 9})[0]
    )
    assert "expected one of 'lm75'" in str(check_settings(BusTemperature.Settings, {"model": "x"})[0])


GOOD = "72 01 4b 46 7f ff 0e 10 57 : crc=57 YES\n72 01 4b 46 7f ff 0e 10 57 t=23125\n"


@pytest.mark.parametrize(
    ("text", "celsius"),
    [
        (GOOD, 23.125),
        (GOOD.replace("t=23125", "t=-1250"), -1.25),
        (GOOD.replace("YES", "NO"), None),
        ("50 05 4b 46 7f ff 0c 10 1c : crc=1c YES\n50 05 4b 46 7f ff 0c 10 1c t=85000\n", None),
        ("", None),
        (GOOD.replace("t=23125", "t="), None),
        (GOOD.replace("t=23125", "t=23_125"), None),
    ],
)
def test_what_linux_tells_of_a_one_wire_thermometer(text: str, celsius: float | None) -> None:
    assert celsius_in(text) == celsius


def test_a_one_wire_thermometer_is_read_and_one_that_is_pulled_out_is_found_again(tmp_path: Path) -> None:
    chip = tmp_path / "28-0316a2794ae1"
    chip.mkdir()
    (chip / "w1_slave").write_text(GOOD)
    with threaded_agent("a", devices=device(OneWireTemperature, folder=str(tmp_path))) as agent:
        assert agent.wait_for(Temperature).body.celsius == 23.125
        chip.rename(tmp_path / "gone")
        assert "cannot be read any more" in agent.wait_for_event("task_failed", task="chip")["error"]
        agent.wait_until(lambda: any("there is no DS18B20" in it["error"] for it in agent.events("task_failed")))
        agent.probe.forget()
        (tmp_path / "gone").rename(chip)
        assert agent.wait_for(Temperature).body.celsius == 23.125


def test_two_one_wire_thermometers_need_their_numbers(tmp_path: Path) -> None:
    for name in ("28-01", "28-02"):
        (tmp_path / name).mkdir()
    with threaded_agent("a", devices=device(OneWireTemperature, folder=str(tmp_path))) as agent:
        assert "set chip to one of 28-01, 28-02" in agent.wait_for_event("task_failed", task="chip")["error"]
