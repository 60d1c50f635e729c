"""Keep the secret of a page, so that open pages come back by themselves after the page's server has restarted."""

from __future__ import annotations

import os
import re
import secrets
import stat
import time
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError
from pancakes.security.key_store import write_private
from pancakes.util.runtime_dir import make_directory, runtime_dir

OLDEST_S: Final = 7 * 24 * 3600.0
"""A secret that was made longer ago is replaced, in seconds."""


def secret_of(port: int, control: bool) -> str:
    """Return the secret of the page at a port: that of the last page there, or a new one.

    Pages with and without control have different secrets. If the secret cannot be kept, each start has another.

    Args:
        port: the port of the page.
        control: whether the page may change what agents do.
    """
    path = runtime_dir() / f"view-{port}{'-control' if control else ''}.token"
    try:
        make_directory(path.parent)
        known = _kept(path)
        if known:
            return known
        made = secrets.token_urlsafe(24)
        write_private(path, made.encode())
    except (OSError, PancakesError):
        return secrets.token_urlsafe(24)
    return made


def _kept(path: Path) -> str:
    """Return the secret in a file; empty if there is none, it is old, or other users could have read or written it."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return ""
    with os.fdopen(handle, "rb") as file:
        about = os.fstat(file.fileno())
        private = stat.S_ISREG(about.st_mode) and not about.st_mode & 0o077 and about.st_uid == os.geteuid()
        if not private or not 0.0 <= time.time() - about.st_mtime <= OLDEST_S:
            return ""
        text = file.read(100).decode("ascii", errors="replace")
    return text if re.fullmatch(r"[A-Za-z0-9_-]{32,64}", text) else ""
