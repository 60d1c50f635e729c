"""What a battery's level is, of what a device tells of it: the one rule of all drivers.

A level that is beyond its range is no reading: a device that tells percent where fractions are expected would always be
full.
"""

from __future__ import annotations

from typing import Final

from pancakes.errors import PancakesError

ROUNDING: Final = 1e-5
"""So much a level may be beyond its range: devices reckon in numbers of 32 bits."""
ABOVE: Final = 0.1
"""While it is charged, a battery's voltage may be above that of a full one by this share of its range."""


def level_of(told: float, full: float) -> float:
    """Returns a level, from 0 to 1.

    Args:
        told: what the device tells.
        full: what it tells when the battery is full: 100 for percent, 1 for fractions.

    Raises:
        PancakesError: that is no level.
    """
    level = told / full
    if not -ROUNDING <= level <= 1.0 + ROUNDING:
        hint = ": set full = 100 if it speaks in percent" if full == 1.0 and 1.0 < told <= 100.0 else ""
        raise PancakesError(f"a level of {told:g} is not between 0 and full = {full:g}{hint}")
    return min(1.0, max(0.0, level))


def level_at(voltage_v: float, empty_v: float, full_v: float) -> float:
    """Returns the level that a voltage means, from 0 to 1; it is taken to be proportional between the two bounds.

    A battery that is more than empty is empty, down to half of that voltage; below, none is connected.

    Raises:
        PancakesError: the voltage is none that this battery can have.
    """
    level = (voltage_v - empty_v) / (full_v - empty_v)
    if level > 1.0 + ABOVE:
        raise PancakesError(f"{voltage_v:g} V is more than a battery has whose full_v is {full_v:g} V: correct full_v")
    if not voltage_v >= 0.5 * empty_v:
        raise PancakesError(
            f"{voltage_v:g} V is less than half of empty_v, which is {empty_v:g} V: is the battery connected?"
        )
    return min(1.0, max(0.0, level))
