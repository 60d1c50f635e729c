"""Files and folders: user folders (XDG), plain files, and whether a file is still the one that was opened.

A pipe in the place of a file is refused, because opening it would wait for ever for its other end.

In a container the user may have neither HOME nor an entry in the passwd file. Then only what needs such a folder is
refused.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError
from pancakes.util.codecs import sha256

_VARIABLE: Final = re.compile(r"\$(?:\w+|\{\w+\})")


class NoPathError(PancakesError):
    """A text is not a path; the message says why."""


class NoHome(NoPathError):
    """A folder of the user is needed, but not known; the message names what to set."""


def at_home(path: str, user: str = "") -> str:
    """Expand `~` and `~user` at the beginning of a path, as a shell does.

    Args:
        path: the path.
        user: whose home `~` is; empty: that of the user of this process.

    Raises:
        NoPathError: it has a NUL in it, or a variable, which is not expanded.
        NoHome: the home folder is not known.
    """
    if "\0" in path:
        raise NoPathError("has a NUL in it, which no path may have")
    found = _VARIABLE.search(path)
    if found:
        raise NoPathError(
            f"has {found[0]} in it, which is not expanded: write `~` for the home folder, or the whole path"
        )
    if not path.startswith("~"):
        return path
    name, slash, rest = path.partition("/")
    whole = os.path.expanduser(f"~{user}{slash}{rest}" if name == "~" and user else path)
    if whole.startswith("~"):
        raise NoHome(f"nothing says where {whole.partition('/')[0]} is: write the whole path")
    return whole


def user_folder(variable: str, below_home: str, what_for: str, instead: str = "") -> Path:
    """Return the folder in an environment variable, or else one below the home of this user.

    Args:
        variable: its name, such as `XDG_STATE_HOME`.
        below_home: where the folder is in a home.
        what_for: what belongs there, for the error message.
        instead: another setting that would name it, for the error message.

    Raises:
        NoHome: neither is known.
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


_OTHERS: Final = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISBLK, "a disk"))


def check_plain(path: str | os.PathLike[str]) -> None:
    """Refuse a path that is not a plain file; it may be missing.

    Raises:
        OSError: it is a pipe, a socket or a disk, or cannot be examined.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    for is_one, what in _OTHERS:
        if is_one(mode):
            raise OSError(errno.EINVAL, f"it is {what}, not a file", os.fspath(path))


def read_plain(path: Path) -> bytes:
    """Return the contents of a plain file.

    Raises:
        OSError: it is not a plain file, or cannot be read.
    """
    check_plain(path)
    return path.read_bytes()


def is_still_at(handle: int, path: str | os.PathLike[str]) -> bool:
    """Return whether a path now leads to an open file."""
    own = os.fstat(handle)
    try:
        there = os.stat(path)
    except OSError:
        return False
    return (own.st_dev, own.st_ino) == (there.st_dev, there.st_ino)


class FileMark:
    """Detect changes of a file since it was read, at the cost of one `stat`.

    Args:
        path: its path; empty, as for a configuration made in code: it never changes.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path).absolute() if path else None  # a task may change the working directory
        self._status = self._look()
        self._digest = self._read()
        self._changed = False

    def changed(self) -> bool:
        """Return whether its contents have changed, or it is gone."""
        if self._digest is None:
            return False
        status = self._look()
        if status != self._status:
            self._status, self._changed = status, self._read() != self._digest
        return self._changed

    def _look(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat() if self._path is not None else None
        except OSError:
            return None
        return (found.st_ino, found.st_size, found.st_mtime_ns) if found is not None else None

    def _read(self) -> bytes | None:
        try:
            return sha256(self._path.read_bytes()) if self._path is not None else None
        except OSError:
            return None
