"""A journal in a directory: one file for each entry, replaced atomically and fsynced."""

from __future__ import annotations

import fcntl
import os
import uuid
from pathlib import Path
from typing import Final

from pancakes.journal.entry import JournalError
from pancakes.journal.journal import BAD, SUFFIX, Journal

_LOCK: Final = "lock"
_TEMPORARY: Final = ".tmp"


class FileJournal(Journal):
    """The journal in an agent's state directory.

    The directory is made if need be, for its owner alone (0700), and locked while the journal is open. An
    entry is written to a temporary file, fsynced, renamed over the old one, and the directory is fsynced:
    a reader finds the old entry or the new one, never a part of either.

    Args:
        directory: the state directory.
        new_uuid: the id that a new journal gets; empty: a random one.

    Raises:
        JournalError: the directory cannot be made or is used by another process; a sentence that names it.
    """

    def __init__(self, directory: Path, new_uuid: str = "") -> None:
        self.directory = directory
        self._lock: int | None = None
        try:
            _make(directory)
            self._lock = _locked(directory)
            self._clear_up()
            self._open(lambda: new_uuid or str(uuid.uuid4()))
        except OSError as error:
            self.close()
            raise JournalError(f"the state directory {directory} cannot be used: {error.strerror}") from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        if self._lock is not None:
            # Closing the file gives the lock back.
            os.close(self._lock)
            self._lock = None

    def _clear_up(self) -> None:
        """Removes temporary files: each is what a write had got to when the agent died, never an entry."""
        for path in sorted(self.directory.glob(f"*{SUFFIX}{_TEMPORARY}")):
            path.unlink()

    def _names(self) -> list[str]:
        return sorted(path.name for path in self.directory.glob(f"*{SUFFIX}"))

    def _place(self, name: str) -> str:
        # Not by pathlib, which has Python keep each part of each path in one table for all: of names that come once,
        # as those of accounts of moves do, the table grew, and was made anew again and again, up to 1 MiB.
        return os.path.join(self.directory, name)

    def _load(self, name: str) -> bytes:
        with open(self._place(name), "rb") as file:
            return file.read()

    def _replace(self, contents: dict[str, bytes]) -> None:
        if self._lock is None:
            raise JournalError(f"the journal in {self.directory} is closed")
        try:
            for name, data in contents.items():
                self._write_temporary(name, data)
            for name in contents:
                os.replace(self._place(name + _TEMPORARY), self._place(name))
            _sync_directory(self.directory)
        except OSError as error:
            raise JournalError(f"the journal in {self.directory} cannot be written: {error.strerror}") from None

    def _write_temporary(self, name: str, data: bytes) -> None:
        handle = os.open(self._place(name + _TEMPORARY), os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    def _rename_bad(self, name: str) -> str:
        bad = name + BAD
        number = 1
        while os.path.exists(self._place(bad)):
            number += 1
            bad = f"{name}.{number}{BAD}"
        os.rename(self._place(name), self._place(bad))
        _sync_directory(self.directory)
        return bad


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
        lock = _locked(directory)
        try:
            # Without an identity the rest is not believed: what a kill leaves here cannot be taken for a whole journal.
            found = sorted(directory.glob(f"*{SUFFIX}*"), key=lambda path: not path.name.startswith("identity."))
            for path in found:
                path.unlink()
            _sync_directory(directory)
        finally:
            os.close(lock)
    except OSError as error:
        raise JournalError(f"the state directory {directory} cannot be emptied: {error.strerror}") from None
    return bool(found)


def _make(directory: Path) -> None:
    """Makes the directory for its owner alone, and sees to it that its name survives a crash as well."""
    if directory.is_dir():
        return
    directory.parent.mkdir(parents=True, exist_ok=True)
    directory.mkdir(mode=0o700)
    _sync_directory(directory.parent)


def _locked(directory: Path) -> int:
    handle = os.open(directory / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(handle, 32, 0).decode("ascii", "replace").strip()
        os.close(handle)
        by = f" (process {holder})" if holder else ""
        raise JournalError(f"the state directory {directory} is in use by another agent{by}") from None
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
    return handle


def _sync_directory(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
