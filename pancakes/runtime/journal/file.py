"""A journal in a directory: one file for each entry, replaced atomically and fsynced."""

from __future__ import annotations

import fcntl
import os
import uuid
from pathlib import Path
from typing import Final

from pancakes.runtime.journal.directory import StateDirectory
from pancakes.runtime.journal.journal import SUFFIX, Journal
from pancakes.runtime.journal.seal import JournalError

_LOCK: Final = "lock"
_TEMPORARY: Final = ".tmp"
CHECK_S: Final = 0.4
"""How often, in seconds, it is looked whether the directory is still there."""


class FileJournal(Journal):
    """The journal in an agent's state directory.

    The directory is made if need be, for its owner alone (0700), and locked while the journal is open. An
    entry is written to a temporary file, fsynced, renamed over the old one, and the directory is fsynced:
    a reader finds the old entry or the new one, never a part of either. All of that is done in the directory that was
    opened, never in another one that has its name since.

    Args:
        directory: the state directory.
        new_uuid: the id that a new journal gets; empty: a random one.
        agent: the name of the agent that opens it.

    Raises:
        JournalError: the directory cannot be made, is used by another process, can be written by other users or
            belongs to one; a sentence that names it.
    """

    check_s = CHECK_S

    def __init__(self, directory: Path, new_uuid: str = "", agent: str = "") -> None:
        self.directory = directory
        self.place = str(directory)
        self._opened: StateDirectory | None = None
        self._lock: int | None = None
        try:
            self._opened = StateDirectory(directory)
            self.remarks = self._opened.remarks
            self._lock = _locked(self._opened)
            self._clear_up()
            self._open(lambda: new_uuid or str(uuid.uuid4()), agent)
        except OSError as error:
            self.close()
            raise JournalError(f"the state directory {directory} cannot be used: {error.strerror}") from None
        except BaseException:
            self.close()
            raise

    def check(self) -> None:
        if self._opened is not None and self._lock is not None:
            self._opened.check(_LOCK, self._lock)

    def close(self) -> None:
        if self._lock is not None:
            # Closing the file gives the lock back.
            os.close(self._lock)
            self._lock = None
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _clear_up(self) -> None:
        """Removes temporary files: each is what a write had got to when the agent died, never an entry."""
        for name in self._names(SUFFIX + _TEMPORARY):
            os.unlink(name, dir_fd=self._handle)

    @property
    def _handle(self) -> int:
        if self._opened is None:
            raise JournalError(f"the journal in {self.directory} is closed")
        return self._opened.handle

    def _names(self, ending: str) -> list[str]:
        return sorted(name for name in os.listdir(self._handle) if name.endswith(ending))

    def _place(self, name: str) -> str:
        # Not by pathlib, which has Python keep each part of each path in one table for all: of names that come once,
        # as those of accounts of moves do, the table grew, and was made anew again and again, up to 1 MiB.
        return os.path.join(self.directory, name)

    def _open_file(self, name: str, flags: int) -> int:
        return os.open(name, flags | os.O_CLOEXEC, 0o600, dir_fd=self._handle)

    def _load(self, name: str) -> bytes:
        with os.fdopen(self._open_file(name, os.O_RDONLY), "rb") as file:
            return file.read()

    def _replace(self, contents: dict[str, bytes]) -> None:
        handle = self._handle
        try:
            for name, data in contents.items():
                self._write_temporary(name, data)
            for name in contents:
                os.replace(name + _TEMPORARY, name, src_dir_fd=handle, dst_dir_fd=handle)
            os.fsync(handle)
        except OSError as error:
            # Of a directory that is gone the operating system says the same as of a file that is not there.
            self.check()
            raise JournalError(f"the journal cannot write: {error.strerror} ({self.directory})") from None
        # What is on disk where the next start does not look for it is not on disk.
        self.check()

    def _write_temporary(self, name: str, data: bytes) -> None:
        handle = self._open_file(name + _TEMPORARY, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    def _rename(self, name: str, new: str) -> None:
        handle = self._handle
        os.rename(name, new, src_dir_fd=handle, dst_dir_fd=handle)
        os.fsync(handle)


def empty(directory: Path) -> bool:
    """Removes the journal in a state directory, and nothing else that lies there.

    Returns:
        Whether there was one.

    Raises:
        JournalError: the directory is used by a process, or cannot be changed; a sentence that names it.
    """
    if not directory.is_dir():
        return False
    try:
        opened = StateDirectory(directory)
        try:
            lock = _locked(opened)
            try:
                # Without an identity the rest is not believed: what a kill leaves is not taken for a whole journal.
                found = [name for name in os.listdir(opened.handle) if SUFFIX in name]
                for name in sorted(found, key=lambda name: not name.startswith("identity.")):
                    os.unlink(name, dir_fd=opened.handle)
                os.fsync(opened.handle)
            finally:
                os.close(lock)
        finally:
            opened.close()
    except OSError as error:
        raise JournalError(f"the state directory {directory} cannot be emptied: {error.strerror}") from None
    return bool(found)


def _locked(opened: StateDirectory) -> int:
    """Locks a state directory for this process; returns the handle that keeps the lock until it is closed."""
    handle = os.open(_LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600, dir_fd=opened.handle)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(handle, 32, 0).decode("ascii", "replace").strip()
        os.close(handle)
        by = f" (process {holder})" if holder else ""
        raise JournalError(f"the state directory {opened.path} is in use by another agent{by}") from None
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
    return handle
