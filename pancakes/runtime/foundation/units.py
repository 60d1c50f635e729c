"""What a person has written with a unit (`2 Hz`, `500ms`), as a key of Pancakes' takes it: a plain number.

The unit is the end of the key: `rate_hz`, `period_s`, `speed_mps`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Final

_UNITS: Final = {
    "hz": ("hz", 1.0),
    "khz": ("hz", 1e3),
    "/s": ("hz", 1.0),
    "1/s": ("hz", 1.0),
    "/min": ("hz", 1 / 60),
    "s": ("s", 1.0),
    "sec": ("s", 1.0),
    "seconds": ("s", 1.0),
    "us": ("s", 1e-6),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "km": ("m", 1e3),
    "m/s": ("mps", 1.0),
    "cm/s": ("mps", 1e-2),
    "km/h": ("mps", 1 / 3.6),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180),
    "rad/s": ("radps", 1.0),
    "deg/s": ("radps", math.pi / 180),
    "v": ("v", 1.0),
    "mv": ("v", 1e-3),
}
"""The units that people write, each with the kind of a key that takes it, and how many of that kind's unit it is."""
_KINDS: Final = {"hz": ("hz", 1.0), "s": ("s", 1.0), "ms": ("s", 1e-3), "m": ("m", 1.0), "mps": ("mps", 1.0)} | {
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "radps": ("radps", 1.0),
    "v": ("v", 1.0),
}
"""The ends of keys, each with its kind, and how many of that kind's unit its own is."""
_INVERSE: Final = {"hz": "s", "s": "hz"}
_RATES: Final = ("rate", "frequency", "freq", "hz", "period", "interval", "every", "sampling")
"""Words for how often something happens, which is a rate here."""
_NUMBER: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d][^\s]*)?\s*")


def number_in(text: str) -> float:
    """Returns the number in a text that a device, a program or a person has written.

    Raises:
        ValueError: it is none; nor is `1_0`, which is 10 in Python only.
    """
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def whole_number_in(text: str) -> int:
    """As `number_in`, for a number without a fraction."""
    if "_" in text:
        raise ValueError(f"invalid literal for int(): {text!r}")
    return int(text)


def written_for(key: str, text: str) -> str:
    """Returns what to write for a key in place of a number in text, such as `rate_hz = 2`; empty: nothing is known.

    Args:
        key: the key, which takes a number.
        text: the text, such as `2 Hz`, `500ms` or `5`.
    """
    found = _NUMBER.fullmatch(text)
    if found is None:
        return ""
    number, unit = float(found[1]), (found[2] or "").lower()
    if not unit:
        return f"{key} = {_shown(number)}"
    kind, factor = _UNITS.get(unit, ("", 1.0))
    own, own_factor = _KINDS.get(key.rpartition("_")[2], ("", 1.0))
    if not kind or not own or not math.isfinite(number):
        return ""
    if own == kind:
        return f"{key} = {_shown(number * factor / own_factor)}"
    if _INVERSE.get(kind) == own and number > 0:
        return f"{key} = {_shown(1.0 / (number * factor) / own_factor)}"
    return ""


def key_for(word: str, text: str, keys: Iterable[str]) -> str:
    """Returns what to write in place of an unknown key with such a value, such as `rate_hz = 2`; empty: nothing.

    Args:
        word: the unknown key.
        text: its value.
        keys: the keys that there are.
    """
    stem = word.lower().partition("_")[0]
    taking = {key: line for key in keys if (line := written_for(key, text)) and "_" in key}
    if found := next((line for key, line in taking.items() if key.partition("_")[0] == stem), ""):
        return found
    rates = [line for key, line in taking.items() if key.endswith("_hz")]
    return rates[0] if stem in _RATES and len(rates) == 1 else ""


def _shown(number: float) -> str:
    return f"{number:.6g}"
