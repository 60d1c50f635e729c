"""The folders of a user, as the XDG base directory specification has them.

A container's user may have neither HOME nor an entry in the passwd file. Only what needs such a folder is refused then.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError

_VARIABLE: Final = re.compile(r"\$(?:\w+|\{\w+\})")


class NoPath(PancakesError):
    """A text is the path of nothing; the sentence says why."""


class NoHome(NoPath):
    """A folder of the user is needed, and nothing says where it is; the sentence names what to set."""


def at_home(path: str, user: str = "") -> str:
    """Returns a path in which `~` and `~user` at its beginning stand for a home folder, as a shell has it.

    Args:
        path: the path.
        user: whose home `~` is; empty: that of the user of this process.

    Raises:
        NoPath: it has a NUL in it, or a variable, which nothing would replace.
        NoHome: nothing says where that is.
    """
    if "\0" in path:
        raise NoPath("has a NUL in it, which no path may have")
    found = _VARIABLE.search(path)
    if found:
        raise NoPath(
            f"has {found[0]} in it, which stays as it is written: write `~` for the home folder, or the whole path"
        )
    if not path.startswith("~"):
        return path
    name, slash, rest = path.partition("/")
    whole = os.path.expanduser(f"~{user}{slash}{rest}" if name == "~" and user else path)
    if whole.startswith("~"):
        raise NoHome(f"nothing says where {whole.partition('/')[0]} is: write the whole path")
    return whole


def user_folder(variable: str, below_home: str, what_for: str, instead: str = "") -> Path:
    """Returns the folder that a variable of the environment names, else one below the home of this user.

    Args:
        variable: its name, such as `XDG_STATE_HOME`.
        below_home: where the folder is in a home.
        what_for: what belongs there, for the sentence.
        instead: what else would say where that belongs, for the sentence.

    Raises:
        NoHome: there is neither.
    """
    base = os.environ.get(variable)
    if base:
        return Path(base)
    try:
        return Path.home() / below_home
    except RuntimeError:
        other = f", or {instead}" if instead else ""
        raise NoHome(
            f"nothing says where {what_for} belongs: the user {os.getuid()} has no home folder."
            f" Set HOME or {variable}{other}"
        ) from None
