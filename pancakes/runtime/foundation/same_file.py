"""Whether a file that is open still is the one of its name: others move and remove files while we write them."""

from __future__ import annotations

import os


def is_still_at(handle: int, path: str | os.PathLike[str]) -> bool:
    """Returns whether an open file is the one that lies at a path now."""
    own = os.fstat(handle)
    try:
        there = os.stat(path)
    except OSError:
        return False
    return (own.st_dev, own.st_ino) == (there.st_dev, there.st_ino)
