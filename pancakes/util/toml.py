"""Parse TOML from untrusted sources within bounds: each fault is one error with its line.

The parser is the standard library's. Files that are larger or deeper than a person would write are refused.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any, Final

MOST_CHARACTERS: Final = 1 << 20
"""The longest text, in characters."""
MOST_PARTS: Final = 32
"""The most parts of a key such as `task.Scan.migrate`: reading takes time with their square."""

MOST_BITS: Final = 4096
"""The longest integer, in bits: a longer one is a fault, and is not shown."""

_PART: Final = r"""(?:[A-Za-z0-9_-]+|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
_FAR: Final = "lies far beyond what can be saved"
_DEEP: Final = re.compile(rf"(?:^|[\[{{,])[ \t]*(?:{_PART}[ \t]*\.[ \t]*){{{MOST_PARTS}}}", re.MULTILINE)
_LONG: Final = re.compile("[0-9][0-9_]{4000}")


class TomlBoundsError(ValueError):
    """A text exceeds a bound.

    Attributes:
        line: the line, from 1; 0: the whole text.
    """

    def __init__(self, problem: str, line: int = 0) -> None:
        super().__init__(problem)
        self.line = line


def toml_values(text: str) -> dict[str, Any]:
    """Parse TOML to plain values.

    Raises:
        tomllib.TOMLDecodeError: it is not TOML.
        TomlBoundsError: it exceeds a bound.
    """
    if len(text) > MOST_CHARACTERS:
        raise TomlBoundsError(f"has {len(text):,} characters, but at most {MOST_CHARACTERS:,} are allowed")
    if found := _DEEP.search(text):
        raise TomlBoundsError(f"a key has more than {MOST_PARTS} parts", _line_of(text, found.end()))
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise TomlBoundsError("is nested too deeply") from None
    except ValueError:  # Python reads only integers of limited length
        long = _LONG.search(text)
        line = _line_of(text, long.start()) if long else 0
        raise TomlBoundsError(f"an integer {_FAR}", line) from None
    if key := _key_beyond(values):
        found = re.search(rf"^.*\b{re.escape(key)}\b.*=", text, re.MULTILINE)
        raise TomlBoundsError(f"{key} {_FAR}", _line_of(text, found.start()) if found else 0)
    return values


def _key_beyond(values: dict[str, Any]) -> str:
    """Return the key of an integer that is too long to show; empty: none."""
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
