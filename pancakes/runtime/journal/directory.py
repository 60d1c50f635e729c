"""An agent's state directory: whose it must be, and whether it is still the one that was opened."""

from __future__ import annotations

import errno
import os
import pwd
import stat
from pathlib import Path
from typing import Final

from pancakes.runtime.journal.seal import JournalError, JournalLost

_OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH
_GONE: Final = (errno.ENOENT, errno.ENOTDIR, errno.ESTALE, errno.ELOOP)


class StateDirectory:
    """The directory, kept open: what is done by its handle is done in it, whatever has its name meanwhile.

    Args:
        path: where it lies; it is made there if need be, for its owner alone (0700). A symbolic link is followed.

    Attributes:
        path: where it lies.
        handle: for calls that take a `dir_fd`.
        remarks: what people should know about it, each a sentence.

    Raises:
        JournalError: other users can write it, or it belongs to one; the message says how to mend that.
        OSError: it cannot be made or opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._absolute = path.absolute()  # the working directory may be changed by what runs here
        self.remarks: tuple[str, ...] = ()
        if path.is_symlink():
            real = os.path.realpath(path)
            self.remarks = (f"the state directory {path} is a symbolic link: what lies in {real} is used",)
            if not os.path.exists(path):
                raise JournalError(f"the state directory {path} is a symbolic link to {real}: make that a directory")
        _make(path)
        self.handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        fault = fault_of(path, os.fstat(self.handle))
        if fault:
            self.close()
            raise JournalError(fault)

    def check(self, lock: str, locked: int) -> None:
        """Looks whether another process could open the directory of this name beside us.

        Args:
            lock: name of the lock file in it.
            locked: the handle by which that is locked.

        Raises:
            JournalLost: it could.
        """
        if not _same(self._absolute, None, self.handle):
            raise JournalLost(f"the state directory {self.path} was removed or replaced while the agent ran")
        if not _same(lock, self.handle, locked):
            raise JournalLost(f"the file {lock} of the state directory {self.path} was removed while the agent ran")

    def close(self) -> None:
        """Lets go of it. Called once."""
        os.close(self.handle)


def fault_of(path: Path, found: os.stat_result) -> str:
    """Says why a state directory must not be used, and how to mend that; empty: it may.

    Args:
        path: where it lies.
        found: what the operating system says of it.
    """
    me = os.geteuid()
    if found.st_uid != me:
        return (
            f"the state directory {path} belongs to {_user(found.st_uid)}, and this is {_user(me)}:"
            f" chown -R {me} {path}, or name another one as state_dir"
        )
    if found.st_mode & _OTHERS:
        return (
            f"the state directory {path} can be written by other users (mode {stat.S_IMODE(found.st_mode):04o}), so"
            f" each of them could change what its tasks are: chmod go-w {path}"
        )
    return ""


def _user(number: int) -> str:
    try:
        return f"the user {pwd.getpwuid(number).pw_name} ({number})"
    except KeyError:
        return f"the user {number}"


def _same(path: Path | str, within: int | None, handle: int) -> bool:
    """Returns whether a path leads to what is open as `handle`; also where the operating system cannot say."""
    try:
        found = os.stat(path, dir_fd=within)
    except OSError as error:
        return error.errno not in _GONE
    opened = os.fstat(handle)
    return (found.st_dev, found.st_ino) == (opened.st_dev, opened.st_ino)


def _make(path: Path) -> None:
    """Makes the directory for its owner alone, and sees to it that its name survives a crash as well."""
    if path.is_dir():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700)
    handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
