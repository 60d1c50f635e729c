"""A thermometer on a one-wire bus, the DS18B20, as Linux shows it in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pancakes.devices import Temperature
from pancakes.devices.driver import Sensor
from pancakes.errors import PancakesError
from pancakes.settings import FilePath
from pancakes.util.text import whole_number_in
from pancakes_pi.real_hardware import refuse_virtual_time


class OneWireTemperature(Sensor):
    """A DS18B20 (`pi.one_wire_temperature`). Needs `dtoverlay=w1-gpio` in the Pi's `config.txt`."""

    type = "temperature"
    blocking = True  # the chip measures for 0.75 s while the file is read

    @dataclass
    class Settings:
        """Which one.

        Attributes:
            chip: its number, such as `28-0316a2794ae1`; empty: the only one.
            folder: where Linux shows the bus.
        """

        chip: str = ""
        folder: FilePath = "/sys/bus/w1/devices"

    settings: Settings

    def open(self) -> None:
        refuse_virtual_time(self.context)
        folder = Path(self.settings.folder)
        chips = sorted(path.name for path in folder.glob("28-*"))
        wanted = self.settings.chip
        if not chips:
            raise PancakesError(f"there is no DS18B20 in {folder}: is dtoverlay=w1-gpio set in config.txt?")
        if wanted and wanted not in chips:
            raise PancakesError(f"there is no chip {wanted} in {folder}, only {', '.join(chips)}")
        if not wanted and len(chips) > 1:
            raise PancakesError(f"there are several chips in {folder}: set chip to one of {', '.join(chips)}")
        self._path = folder / (wanted or chips[0]) / "w1_slave"

    def read(self) -> Temperature:
        try:
            celsius = celsius_in(self._path.read_text())
        except OSError as error:
            raise PancakesError(f"{self._path} cannot be read any more: {error.strerror}") from None
        if celsius is None:
            raise PancakesError("a reading came with a wrong CRC, or before the chip had measured")
        return Temperature(celsius)


def celsius_in(text: str) -> float | None:
    """Returns the temperature that the file of a chip tells; None where its CRC is wrong, or it has not measured yet.

    A DS18B20 that has just got power says 85 degrees; its scratchpad then begins with 50 05.
    """
    first, _, second = text.partition("\n")
    if not first.endswith("YES") or first.startswith("50 05") or "t=" not in second:
        return None
    try:
        return whole_number_in(second.rpartition("t=")[2]) / 1000.0
    except ValueError:
        return None
