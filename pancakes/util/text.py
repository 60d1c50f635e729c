"""Text that people type and read: valid names, "did you mean", numbers with units, escaped control characters.

A name (of an agent, fleet, task, service, device or channel) is a part of addresses, file names and log lines, and some
come from other machines, so names are only ASCII. Types such as `energy.governor` are not names.

A peer, a plug-in or a recording may send any text, also one that moves a terminal's cursor: `printable` shows such
characters as Python writes them (`\\x1b`). Units are the end of a key (`rate_hz`, `period_s`, `speed_mps`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from typing import Final

LONGEST: Final = 64
NAME: Final = r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}"
"""A regular expression for a whole name."""
_OF_CLIENT: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"


def fault_of_name(name: str, client: bool = False) -> str:
    """Return why a text is not a name, as a sentence that shows it safely; empty: it is one.

    Args:
        name: the name.
        client: whether it is the name of a terminal or a person, which may have dots.
    """
    if re.fullmatch(_OF_CLIENT if client else NAME, name):
        return ""
    dot = ", '.'" if client else ""
    first = "'-' or '.'" if client else "'-'"
    return (
        f"{name if len(name) <= 2 * LONGEST else name[:LONGEST] + '...'!a} is not a name: a name has letters from a"
        f" to z and A to Z, digits, '_'{dot} and '-', does not begin with {first}, and is at most {LONGEST} long"
    )


def nearest_name(text: str) -> str:
    """Return what a person may have meant by a text that is not a name; empty: unknown."""
    near = re.sub(r"[^A-Za-z0-9_-]+", "_", text.lstrip(".-"))[:LONGEST]
    return near if re.fullmatch(NAME, near) else ""


SAME_AS: Final = {
    "always": "each",
    "async": "lazy",
    "automatic": "auto",
    "critical": "error",
    "err": "error",
    "every": "each",
    "exception": "error",
    "fatal": "error",
    "immediate": "each",
    "manual": "ask",
    "never": "no",
    "none": "no",
    "notice": "info",
    "onfailure": "on-failure",
    "permanent": "always",
    "sync": "each",
    "temporary": "no",
    "trace": "debug",
    "transient": "on-failure",
    "unless-stopped": "always",
    "warn": "warning",
}
"""Words that others use, with the words used here: similar letters would suggest a wrong word, even the opposite."""


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the known word that is nearest to `word`, or an empty string if none is near.

    Upper and lower case are equal. `ScanTarget` also finds `encirclement.ScanTarget`: leaving out the part before the
    last dot is the most common mistake with names of plug-ins. A word with a dot is near another if both of its parts
    are: a similar name in another family is something else, such as the temperature of another thing. An address is
    such a word too, with a slash; one without the service finds its task.
    """
    folded = {name.lower(): name for name in sorted(known, reverse=True)}
    meant = SAME_AS.get(word.lower(), "")
    if meant in folded:
        return folded[meant]
    family, tail = _parted(word.lower())
    if not family:
        near = _near(tail, folded)
        if near:
            return folded[near]
        tails = {_parted(name)[1]: name for name in folded}
        near = _near(tail, tails, 0.75)
        return folded[tails[near]] if near else ""
    families: dict[str, dict[str, str]] = {}
    for name in sorted(folded, reverse=True):
        before, after = _parted(name)
        families.setdefault(before, {})[after] = folded[name]
    for near_family in _all_near(family, families, 0.75):
        near = _near(tail, families[near_family])
        if near:
            return families[near_family][near]
    within = (name for name in sorted(folded) if name.startswith(f"{family}/") and name.endswith(f"/{tail}"))
    return families.get("", {}).get(tail, "") or folded.get(next(within, ""), "")


def _parted(word: str) -> tuple[str, str]:
    """Return the parts of a word before and after its last dot or slash."""
    at = max(word.rfind("."), word.rfind("/"))
    return word[: max(at, 0)], word[at + 1 :]


def _near(word: str, known: Iterable[str], alike: float = 0.6) -> str:
    return next(iter(_all_near(word, known, alike)), "")


def _all_near(word: str, known: Iterable[str], alike: float) -> list[str]:
    """Return the words that are near, the nearest first.

    Args:
        word: the word.
        known: the known words.
        alike: the share of letters that must be the same.
    """
    from difflib import get_close_matches  # only if something went wrong

    found = get_close_matches(word, sorted(known), n=3, cutoff=alike)
    return [it for it in found if _is_mistyped(word, it)]


def _is_mistyped(word: str, other: str) -> bool:
    """Return whether few typing mistakes lead from one word to the other, or one is the other cut short.

    Common letters are not enough: `always` has four of its six letters in `lazy`, and means the opposite.
    """
    short, long = sorted((word, other), key=len)
    if len(short) >= 3 and (long.startswith(short) or long.endswith(short)):
        return True
    return _slips(word, other) <= len(long) // 2


def _slips(word: str, other: str) -> int:
    """Return how many letters must be inserted, removed, changed or swapped with the next one."""
    before: list[int] = []
    row = list(range(len(other) + 1))
    for i, letter in enumerate(word):
        above, before, row = before, row, [i + 1]
        for j, wanted in enumerate(other):
            slips = min(before[j + 1] + 1, row[j] + 1, before[j] + (letter != wanted))
            if i and j and letter == other[j - 1] and word[i - 1] == wanted:
                slips = min(slips, above[j - 1] + 1)
            row.append(slips)
    return row[-1]


def did_you_mean(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return the end of a sentence that refuses a word: `, did you mean 'x'?`; `otherwise` if no word is near."""
    near = suggestion(word, known)
    return f", did you mean {near!r}?" if near else otherwise


def hint_of(word: str, known: Collection[str]) -> str:
    """Return the same as `did_you_mean`; if no word is near, list all: `, only a, b`."""
    return did_you_mean(word, known, f", only {', '.join(known)}" if known else "")


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
"""The units that people write, each with its kind, and its size in the base unit of that kind."""
_KINDS: Final = {"hz": ("hz", 1.0), "s": ("s", 1.0), "ms": ("s", 1e-3), "m": ("m", 1.0), "mps": ("mps", 1.0)} | {
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "radps": ("radps", 1.0),
    "v": ("v", 1.0),
}
"""The unit suffixes of keys, each with its kind, and its size in the base unit of that kind."""
_INVERSE: Final = {"hz": "s", "s": "hz"}
_RATES: Final = ("rate", "frequency", "freq", "hz", "period", "interval", "every", "sampling")
"""Words for how often something happens, which is a rate here."""
_NUMBER: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d][^\s]*)?\s*")


def number_in(text: str) -> float:
    """Parse a number that a device, a program or a person has written.

    Raises:
        ValueError: it is not a number; nor is `1_0`, which is 10 only in Python.
    """
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def whole_number_in(text: str) -> int:
    """Parse a number without a fraction; see `number_in`."""
    if "_" in text:
        raise ValueError(f"invalid literal for int(): {text!r}")
    return int(text)


def written_for(key: str, text: str) -> str:
    """Return what to write for a key instead of a number as text, such as `rate_hz = 2`; empty: unknown.

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
    """Return what to write instead of an unknown key and its value, such as `rate_hz = 2`; empty: unknown.

    Args:
        word: the unknown key.
        text: its value.
        keys: the known keys.
    """
    stem = word.lower().partition("_")[0]
    taking = {key: line for key in keys if (line := written_for(key, text)) and "_" in key}
    if found := next((line for key, line in taking.items() if key.partition("_")[0] == stem), ""):
        return found
    rates = [line for key, line in taking.items() if key.endswith("_hz")]
    return rates[0] if stem in _RATES and len(rates) == 1 else ""


def _shown(number: float) -> str:
    return f"{number:.6g}"


# Control characters except new lines and tabs; marks that change the direction of text or end a line invisibly; and
# halves of surrogate pairs, which cannot be encoded.
_HIDDEN: Final = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ufeff\\ud800-\\udfff]"
)


def printable(text: str) -> str:
    """Return text that is safe to show: control characters except new lines and tabs are escaped."""
    return text if text.isprintable() else _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], text)


def printable_line(text: str) -> str:
    """Return text that is safe in a log: like `printable`, and later lines do not look like entries."""
    return printable(text).replace("\n", "\n    ")


def printable_data(text: str) -> str:
    """Return equivalent JSON or TOML that is safe to show: characters that `printable` escapes are escaped."""
    return text if text.isprintable() else _HIDDEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
