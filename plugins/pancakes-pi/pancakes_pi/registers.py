"""What the registers of chips on an I²C bus mean, by their datasheets. Pure. The higher byte of a word comes first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import msgspec


class Chip(msgspec.Struct, frozen=True):
    """A chip that measures one thing.

    Attributes:
        register: where the reading stands, a word.
        addresses: where it may be on the bus.
        value: what the word means.
    """

    register: int
    addresses: range
    value: Callable[[int], float]


def _lm75_celsius(word: int) -> float:
    """LM75A (NXP, rev. 5, 7.4.3): 11 bits, two's complement, from the left; 0.125 degrees each."""
    return _signed(word >> 5, 11) * 0.125


def _tmp102_celsius(word: int) -> float:
    """TMP102 (TI, SLOS397, 7.5.2): 12 bits, two's complement, from the left; 0.0625 degrees each."""
    return _signed(word >> 4, 12) * 0.0625


def _mcp9808_celsius(word: int) -> float:
    """MCP9808 (Microchip, DS25095, 5.2.3): 13 bits, two's complement, below three flags; 0.0625 degrees each."""
    return _signed(word & 0x1FFF, 13) * 0.0625


def _ina219_volts(word: int) -> float:
    """INA219 (TI, SBOS448, 8.6.3.2): 13 bits above three flags; 4 mV each."""
    return (word >> 3) * 0.004


THERMOMETERS: Final[Mapping[str, Chip]] = {
    "lm75": Chip(0x00, range(0x48, 0x50), _lm75_celsius),
    "tmp102": Chip(0x00, range(0x48, 0x4C), _tmp102_celsius),
    "mcp9808": Chip(0x05, range(0x18, 0x20), _mcp9808_celsius),
}
VOLTMETERS: Final[Mapping[str, Chip]] = {"ina219": Chip(0x02, range(0x40, 0x50), _ina219_volts)}


def _signed(bits: int, count: int) -> int:
    return bits - (1 << count) if bits & (1 << (count - 1)) else bits


def word_of(data: bytes | list[int]) -> int:
    """Returns the word that two bytes from the bus make."""
    return data[0] << 8 | data[1]
