"""A user as containers have it: without HOME, and without an entry in the passwd file."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from functools import cache

UID = 54321
_ENTER = ["unshare", "--user", f"--map-user={UID}", f"--map-group={UID}"]


@cache
def may_be_nameless() -> bool:
    """Returns whether this machine lets its users have a namespace of their own."""
    return shutil.which("unshare") is not None and not subprocess.run([*_ENTER, "true"]).returncode


def as_nameless(*command: str) -> list[str]:
    """Returns a command as such a user runs it."""
    return [*_ENTER, *command]


def without_folders(environment: Mapping[str, str]) -> dict[str, str]:
    """Returns an environment that says nothing of the user's folders."""
    return {key: value for key, value in environment.items() if key != "HOME" and not key.startswith("XDG_")}
