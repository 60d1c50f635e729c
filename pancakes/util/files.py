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


class NoPath(PancakesError):
    """A text is the path of nothing; the sentence says why."""


class NoHome(NoPath):
    """A folder of the user is needed, and nothing says where it is; the sentence names what to set."""


def at_home(path: str, user: str = "") -> str:
    """Return a path in which `~` and `~user` at its beginning stand for a home folder, as a shell has it.

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
    """Return the folder that a variable of the environment names, else one below the home of this user.

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


_OTHERS: Final = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISBLK, "a disk"))


def check_plain(path: str | os.PathLike[str]) -> None:
    """Refuse what is no file; one that is not there may be made.

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
    """Return what is in a file.

    Raises:
        OSError: it is none, or cannot be read.
    """
    check_plain(path)
    return path.read_bytes()


def is_still_at(handle: int, path: str | os.PathLike[str]) -> bool:
    """Return whether an open file is the one that lies at a path now."""
    own = os.fstat(handle)
    try:
        there = os.stat(path)
    except OSError:
        return False
    return (own.st_dev, own.st_ino) == (there.st_dev, there.st_ino)


class FileMark:
    """A file as it was read; it costs a look at the file's status to ask whether it has changed.

    Args:
        path: where it is; what is at no path, as a configuration made in code, never changes.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path).absolute() if path else None  # the working directory may be changed by what runs here
        self._status = self._look()
        self._digest = self._read()
        self._changed = False

    def changed(self) -> bool:
        """Return whether it says something else by now, or is gone."""
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
