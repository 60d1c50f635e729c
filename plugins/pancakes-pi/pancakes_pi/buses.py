"""Chips on an I²C bus, by smbus2: thermometers and a voltmeter."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta

from pancakes.devices import Battery, Temperature
from pancakes.devices.driver import Hardware, Sensor, why_not_opened
from pancakes.devices.validation import level_at
from pancakes.errors import PancakesError
from pancakes.settings import Positive
from pancakes_pi.real_hardware import refuse_virtual_time
from pancakes_pi.registers import THERMOMETERS, VOLTMETERS, Chip, word_of

TRIES = 3
"""A chip is asked so often when its device is opened, before it is taken to be missing."""


class BusSensor(Sensor):
    """A chip on an I²C bus. One that does not answer now and then is missed; see `missed` of `[device.NAME]`."""

    blocking = True  # the bus is slow, and a chip may stretch its clock

    @dataclass(kw_only=True)
    class Settings:
        """Where it is.

        Attributes:
            bus: the number of the bus: 1 is that on the pins of a Raspberry Pi.
            address: the chip's address; without it, its lowest one.
        """

        bus: Annotated[int, Meta(ge=0)] = 1
        address: Annotated[int, Meta(ge=0x08, le=0x77)] | None = None

    settings: Any
    _bus: Any = None

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return (Hardware(f"/dev/i2c-{settings.bus}", "i2c"),)

    @abstractmethod
    def chip(self) -> Chip:
        """Returns which chip it is."""

    def open(self) -> None:
        refuse_virtual_time(self.context)
        self._address()
        import smbus2

        try:
            self._bus = smbus2.SMBus(self.settings.bus)
        except OSError as error:
            raise PancakesError(
                f"the bus /dev/i2c-{self.settings.bus} cannot be opened ({why_not_opened(error)});"
                " raspi-config switches buses on"
            ) from None
        for left in reversed(range(TRIES)):
            try:
                self.measured()
                return
            except PancakesError:
                if not left:
                    raise

    def close(self) -> None:
        if self._bus is not None:
            self._bus.close()

    def measured(self) -> float:
        """Returns what the chip says.

        Raises:
            PancakesError: it does not answer.
        """
        chip, address = self.chip(), self._address()
        try:
            data = self._bus.read_i2c_block_data(address, chip.register, 2)
        except OSError as error:
            where = f"0x{address:02x} on /dev/i2c-{self.settings.bus}"
            raise PancakesError(
                f"no chip answers at {where} ({error.strerror or error}): look with i2cdetect"
            ) from None
        return chip.value(word_of(data))

    def _address(self) -> int:
        addresses, address = self.chip().addresses, self.settings.address
        if address is not None and address not in addresses:
            raise PancakesError(
                f"address = 0x{address:02x}: this chip is at 0x{addresses[0]:02x} to 0x{addresses[-1]:02x}"
            )
        return addresses[0] if address is None else int(address)


class BusTemperature(BusSensor):
    """A thermometer on an I²C bus (`pi.temperature`)."""

    type = "temperature"

    @dataclass(kw_only=True)
    class Settings(BusSensor.Settings):
        """Which one, and where.

        Attributes:
            model: the chip.
        """

        model: Literal["lm75", "tmp102", "mcp9808"]

    def chip(self) -> Chip:
        return THERMOMETERS[self.settings.model]

    def read(self) -> Temperature:
        return Temperature(self.measured())


class BusBattery(BusSensor):
    """A battery whose voltage an INA219 measures (`pi.battery`)."""

    type = "battery"

    @dataclass(kw_only=True)
    class Settings(BusSensor.Settings):
        """Where it is, and how the battery is.

        Attributes:
            full_v: its voltage when it is full.
            empty_v: its voltage when it is empty; the level is taken to be proportional between them.
        """

        full_v: Positive
        empty_v: Positive

        def __post_init__(self) -> None:
            if self.empty_v >= self.full_v:
                raise ValueError(f"empty_v is {self.empty_v:g} V, not below full_v, which is {self.full_v:g} V")

    def chip(self) -> Chip:
        return VOLTMETERS["ina219"]

    def read(self) -> Battery:
        settings, voltage_v = self.settings, self.measured()
        return Battery(voltage_v, level_at(voltage_v, settings.empty_v, settings.full_v))
