"""Text of others as it may reach a terminal or a log: with its control characters escaped.

A peer, a plug-in or a recording may say anything, also what tells a terminal to change its title, to move its cursor,
or to show text from right to left. What is escaped here is shown instead, as Python writes it: `\\x1b`.
"""

from __future__ import annotations

import re
from typing import Final

# Controls of both sets but for a new line and a tab; marks that turn the direction of text, or end a line unseen; and
# halves of characters, which cannot be written.
_HIDDEN: Final = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ufeff\\ud800-\\udfff]"
)


def printable(text: str) -> str:
    """Returns text as it may be shown: with control characters escaped, all but new lines and tabs."""
    return text if text.isprintable() else _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], text)


def printable_line(text: str) -> str:
    """Returns text as it may stand in a log: as `printable`, and lines after the first look like no entry."""
    return printable(text).replace("\n", "\n    ")


def printable_data(text: str) -> str:
    """Returns JSON, or TOML, that means the same and may be shown: what `printable` escapes is written as both do."""
    return text if text.isprintable() else _HIDDEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
