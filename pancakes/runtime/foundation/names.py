"""What the names of agents, fleets, tasks, services, devices and channels are made of.

Names are parts of addresses (`agent/service/task`), of file names and of lines that people read, and some come from
other machines. So they are of ASCII alone: a name that looks like another, or moves a terminal's cursor, is none. Types
(`energy.governor`) are no names: their dots lead to the plug-in.
"""

from __future__ import annotations

import re
from typing import Final

LONGEST: Final = 64
NAME: Final = r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}"
"""A regular expression for the whole of a name."""
_OF_CLIENT: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"


def fault_of_name(name: str, client: bool = False) -> str:
    """Returns why something is no name, as a sentence that shows it safely; empty where it is one.

    Args:
        name: the name.
        client: whether it is that of a terminal or a person, which may have dots.
    """
    if re.fullmatch(_OF_CLIENT if client else NAME, name):
        return ""
    dot = ", '.'" if client else ""
    first = "'-' or '.'" if client else "'-'"
    return (
        f"{name if len(name) <= 2 * LONGEST else name[:LONGEST] + '...'!a} is no name: a name has letters from a"
        f" to z and A to Z, digits, '_'{dot} and '-', does not begin with {first}, and is at most {LONGEST} long"
    )


def nearest_name(text: str) -> str:
    """Returns what a person may have meant by something that is no name; empty where that cannot be said."""
    near = re.sub(r"[^A-Za-z0-9_-]+", "_", text.lstrip(".-"))[:LONGEST]
    return near if re.fullmatch(NAME, near) else ""
