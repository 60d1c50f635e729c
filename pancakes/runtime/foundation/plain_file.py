"""A pipe in the place of a file that somebody named: opening it would wait for ever for its other end."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

_OTHERS: Final = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISBLK, "a disk"))


def check_plain(path: str | os.PathLike[str]) -> None:
    """Refuses what is no file; one that is not there may be made.

    Raises:
        OSError: it is a pipe, a socket or a disk, or cannot be looked at.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    for is_one, what in _OTHERS:
        if is_one(mode):
            raise OSError(errno.EINVAL, f"it is {what}, and no file", os.fspath(path))


def read_plain(path: Path) -> bytes:
    """Returns what is in a file.

    Raises:
        OSError: it is none, or cannot be read.
    """
    check_plain(path)
    return path.read_bytes()
