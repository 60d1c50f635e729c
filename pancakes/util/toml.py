"""Parse TOML from untrusted sources within bounds: each fault is one error with its line.

The parser is the standard library's. Files that are larger, deeper or longer than a person writes are refused.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any, Final

MOST_CHARACTERS: Final = 1 << 20
"""No file that a person writes is longer."""
MOST_PARTS: Final = 32
"""A key has no more parts, as in `task.Scan.migrate`: what is read takes the square of them."""

MOST_BITS: Final = 4096
"""Of a longer integer nothing is said but that."""

_PART: Final = r"""(?:[A-Za-z0-9_-]+|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
_FAR: Final = "lies far beyond what can be saved"
_DEEP: Final = re.compile(rf"(?:^|[\[{{,])[ \t]*(?:{_PART}[ \t]*\.[ \t]*){{{MOST_PARTS}}}", re.MULTILINE)
_LONG: Final = re.compile("[0-9][0-9_]{4000}")


class TomlBoundsError(ValueError):
    """A text is beyond what is read of TOML.

    Attributes:
        line: the line, from 1; 0: it is the whole text.
    """

    def __init__(self, problem: str, line: int = 0) -> None:
        super().__init__(problem)
        self.line = line


def toml_values(text: str) -> dict[str, Any]:
    """Return what TOML says, as plain values.

    Raises:
        tomllib.TOMLDecodeError: it is no TOML.
        TomlBoundsError: it is larger, deeper or longer than TOML that a person has written.
    """
    if len(text) > MOST_CHARACTERS:
        raise TomlBoundsError(f"has {len(text):,} characters, and {MOST_CHARACTERS:,} are the most")
    if found := _DEEP.search(text):
        raise TomlBoundsError(f"a key has more than {MOST_PARTS} parts", _line_of(text, found.end()))
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise TomlBoundsError("is nested too deeply") from None
    except ValueError:  # Python reads no longer integer
        long = _LONG.search(text)
        line = _line_of(text, long.start()) if long else 0
        raise TomlBoundsError(f"an integer {_FAR}", line) from None
    if key := _key_beyond(values):
        found = re.search(rf"^.*\b{re.escape(key)}\b.*=", text, re.MULTILINE)
        raise TomlBoundsError(f"{key} {_FAR}", _line_of(text, found.start()) if found else 0)
    return values


def _key_beyond(values: dict[str, Any]) -> str:
    """Return the key of an integer that could not even be shown; empty: there is none."""
    left: list[tuple[str, Any]] = list(values.items())
    while left:
        key, value = left.pop()
        if isinstance(value, dict):
            left += value.items()
        elif isinstance(value, list):
            left += [(key, item) for item in value]
        elif isinstance(value, int) and value.bit_length() > MOST_BITS:
            return key
    return ""


def _line_of(text: str, place: int) -> int:
    return text.count("\n", 0, place) + 1
