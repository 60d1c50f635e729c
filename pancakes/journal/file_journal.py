"""A journal in a directory: one file for each entry, replaced atomically, behind a write-ahead file.

A write that replaces a file costs several rounds of the disk. So a batch is first appended to the write-ahead file,
with one fsync; its entries get files of their own later. The directory must belong to the agent's user. It is locked
while the journal is open, and kept open: all access goes through its handle, so it always is the directory that was
opened, even if another one has its name by then. Some room is reserved for a full disk.
"""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import stat
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from pancakes.journal.journal import (
    BAD,
    SUFFIX,
    DiskUse,
    Journal,
    JournalEntry,
    JournalError,
    JournalLostError,
    name_of,
    seal,
)
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, sha256

WRITE_AHEAD: Final = "journal.wal"
"""The name of the file."""
_MAGIC: Final = b"PNCKWAL1"
_LENGTH_BYTES: Final = 8
_DIGEST_BYTES: Final = 32
_HEAD_BYTES: Final = len(_MAGIC) + _LENGTH_BYTES + _DIGEST_BYTES


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """Entries that were written together.

    Attributes:
        journal: the id of the journal that has written it.
        entries: the entries.
    """

    journal: str
    entries: tuple[JournalEntry, ...]


class WrittenAhead(NamedTuple):
    """The contents of a write-ahead file.

    Attributes:
        batches: the batches, up to the first that is not valid.
        damaged: whether valid batches follow that one. If not, the machine died during the last write, which no caller
            was told had succeeded.
    """

    batches: Sequence[Batch]
    damaged: bool


_DECODE: Final = codecs.decoder(Batch)


def seal_batch(journal: str, entries: Sequence[JournalEntry]) -> bytes:
    """Return a batch as it is appended to the file.

    Raises:
        JournalError: out of memory.
    """
    try:
        body = codecs.encode(Batch(journal, tuple(entries)))
    except MemoryError as error:
        raise JournalError(f"{len(entries)} entries of the journal cannot be written: {error}") from None
    return b"".join((_MAGIC, len(body).to_bytes(_LENGTH_BYTES, "big"), sha256(body), body))


def read_ahead(data: bytes) -> WrittenAhead:
    """Read a write-ahead file."""
    batches, at = [], 0
    while found := _batch_at(data, at):
        batch, at = found
        batches.append(batch)
    return WrittenAhead(batches, any(_batch_at(data, later) is not None for later in _marks(data, at + 1)))


def _batch_at(data: bytes, at: int) -> tuple[Batch, int] | None:
    """Return the batch that begins at a byte, and where the next one begins; None: no valid batch begins there."""
    head = data[at : at + _HEAD_BYTES]
    if not head.startswith(_MAGIC) or len(head) < _HEAD_BYTES:
        return None
    length = int.from_bytes(head[len(_MAGIC) : len(_MAGIC) + _LENGTH_BYTES], "big")
    begin = at + _HEAD_BYTES
    body = data[begin : begin + length]
    if len(body) < length or sha256(body) != head[-_DIGEST_BYTES:]:
        return None
    try:
        return _DECODE(body), begin + length
    except MALFORMED:
        return None


def _marks(data: bytes, at: int) -> Iterator[int]:
    """Return where batches may begin, from a byte on."""
    while (at := data.find(_MAGIC, at)) >= 0:
        yield at
        at += 1


_OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH
_GONE: Final = (errno.ENOENT, errno.ENOTDIR, errno.ESTALE, errno.ELOOP)


class StateDirectory:
    """The directory, kept open: access by its handle goes to it, even if another one has its name meanwhile.

    Args:
        path: its path; it is created if missing, only for its owner (0700). A symbolic link is followed.

    Attributes:
        path: its path.
        handle: for calls that take a `dir_fd`.
        remarks: what people should know about it, each a sentence.

    Raises:
        JournalError: other users can write it, or it belongs to one; the message says how to fix that.
        OSError: it cannot be made or opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._absolute = path.absolute()  # a task may change the working directory
        self.remarks: tuple[str, ...] = ()
        if path.is_symlink():
            real = os.path.realpath(path)
            self.remarks = (f"the state directory {path} is a symbolic link: {real} is used",)
            if not os.path.exists(path):
                raise JournalError(f"the state directory {path} is a symbolic link to {real}: make it a directory")
        _make(path)
        self.handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        fault = fault_of(path, os.fstat(self.handle))
        if fault:
            self.close()
            raise JournalError(fault)

    def check(self, lock: str, locked: int) -> None:
        """Check that no other process could open a directory of this name too.

        Args:
            lock: name of the lock file in it.
            locked: the handle that locks it.

        Raises:
            JournalLostError: one could.
        """
        if not _same(self._absolute, None, self.handle):
            raise JournalLostError(f"the state directory {self.path} was removed or replaced while the agent ran")
        if not _same(lock, self.handle, locked):
            raise JournalLostError(
                f"the file {lock} of the state directory {self.path} was removed while the agent ran"
            )

    def close(self) -> None:
        """Close it. Call this once."""
        os.close(self.handle)


def fault_of(path: Path, found: os.stat_result) -> str:
    """Return why a state directory must not be used, and how to fix that; empty: it may.

    Args:
        path: its path.
        found: its `stat`.
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
            f" each of them could change its tasks: chmod go-w {path}"
        )
    return ""


def _user(number: int) -> str:
    try:
        return f"the user {pwd.getpwuid(number).pw_name} ({number})"
    except KeyError:
        return f"the user {number}"


def _same(path: Path | str, within: int | None, handle: int) -> bool:
    """Return whether a path leads to the file that is open as `handle`, or this cannot be known."""
    try:
        found = os.stat(path, dir_fd=within)
    except OSError as error:
        return error.errno not in _GONE
    opened = os.fstat(handle)
    return (found.st_dev, found.st_ino) == (opened.st_dev, opened.st_ino)


def _make(path: Path) -> None:
    """Make the directory only for its owner, and make sure that its name survives a crash too."""
    if path.is_dir():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700)
    handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


_LOCK: Final = "lock"
_MARK: Final = "mark"
_TEMPORARY: Final = ".tmp"
_RESERVE: Final = "reserve"
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
RESERVE_BYTES: Final = 128 * 2**10
"""Room that is reserved for a full disk: to start, and to give written-ahead entries their own files."""
_BLOCK_BYTES: Final = 4096
"""The overhead of a file on disk: this many bytes, and up to as many again."""
CHECK_S: Final = 0.8
"""How often, in seconds, the directory is checked."""
MOST_AHEAD_BYTES: Final = 16 * 2**20
"""If the write-ahead file would become longer, its entries get files of their own, ..."""
MOST_AHEAD: Final = 2000
"""... and if it would have more entries: a disk may take a second for this many files. An agent with a thousand tasks
has not as many while it starts."""
MOST_AT_END: Final = 100
"""With more entries than this, they stay there when the journal closes: its agent has two seconds to end."""
LARGE_BYTES: Final = 256 * 2**10
"""A batch with more bytes than this for each entry is not written ahead: it would be written twice."""


class FileJournal(Journal):
    """The journal in an agent's state directory.

    The directory is created if missing, only for its owner (0700), and locked while the journal is open. Each entry has
    a file of its own: it is written to a temporary file, fsynced, and renamed over the old one; then the directory is
    fsynced. So a reader finds the old entry or the new one, never a part of either. As that costs several rounds of the
    disk for each entry, a batch is first appended to one file, with one fsync. Its entries get files of their own once
    that file is long, when the disk has little room left, when the journal is closed (if that is quick), and otherwise
    at the next opening. All of that happens in the directory that was opened, even if another one has its name by then.

    Args:
        directory: the state directory.
        new_uuid: the id of a new journal; empty: a random one.
        agent: the name of the agent that opens it.

    Raises:
        JournalError: the directory cannot be created, is used by another process, can be written by other users or
            belongs to one; the message names it.
    """

    check_s = CHECK_S

    def __init__(self, directory: Path, new_uuid: str = "", agent: str = "") -> None:
        self.directory = directory
        self.place = str(directory)
        self._opened: StateDirectory | None = None
        self._lock: int | None = None
        self._ahead: dict[str, JournalEntry] = {}  # entries that are only in the write-ahead file, by name
        self._ahead_bytes = 0
        self._ahead_torn = False  # whether it ends with a batch that was not written completely
        self._reserved = False  # whether the room is reserved
        try:
            self._opened = StateDirectory(directory)
            self.remarks = self._opened.remarks
            self._lock = _locked(self._opened)
            self._clear_up()
            doubt = self._recover()
            self._with_reserve(lambda: self._open(lambda: new_uuid or str(uuid.uuid4()), agent, doubt))
            if self.copied:
                self.remarks += (
                    f"the state directory {directory} is a copy, such as a restored backup: what was written to the"
                    " original since then is not in it",
                )
            if doubt:
                self._rename(WRITE_AHEAD, WRITE_AHEAD + BAD)
            self._reserve()
        except OSError as error:
            self.close()
            room = "; make room on its disk, or name another one as state_dir" if error.errno in _FULL else ""
            raise JournalError(f"the state directory {directory} cannot be used: {error.strerror}{room}") from None
        except BaseException:
            self.close()
            raise

    def check(self) -> None:
        if self._opened is not None and self._lock is not None:
            self._opened.check(_LOCK, self._lock)
            if not self._reserved:
                self._reserve()

    def close(self) -> None:
        if 0 < len(self._ahead) <= MOST_AT_END:
            with suppress(JournalError):  # the next opening does it again
                self._put_in_place()
        if self._lock is not None:
            # Closing the file releases the lock.
            os.close(self._lock)
            self._lock = None
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _clear_up(self) -> None:
        """Remove temporary files: each is left of a write during which the agent died, never an entry."""
        for name in self._names(SUFFIX + _TEMPORARY):
            os.unlink(name, dir_fd=self._handle)

    def _recover(self) -> str:
        """Give files to entries that were written ahead earlier; return why the journal is not valid, if so."""
        try:
            batches, damaged = read_ahead(self._load(WRITE_AHEAD))
        except FileNotFoundError:
            return ""
        newest = {name_of(it.kind, it.key): (batch.journal, it) for batch in batches for it in batch.entries}
        self._with_reserve(lambda: self._replace({name: seal(*found) for name, found in newest.items()}))
        if damaged:
            return f"is not believed: {WRITE_AHEAD} beside it is damaged, so later entries are lost"
        of_others = [journal for journal in {batch.journal for batch in batches} if not self._is_of(journal)]
        if of_others:
            return f"is not believed: {WRITE_AHEAD} beside it is of the journal {of_others[0]}"
        self._remove_ahead()
        return ""

    def _store(self, newest: Mapping[str, JournalEntry]) -> None:
        data = seal_batch(self.uuid, list(newest.values()))
        large = len(data) >= LARGE_BYTES * len(newest)
        full = self._ahead_bytes + len(data) > MOST_AHEAD_BYTES or len(self._ahead) + len(newest) > MOST_AHEAD
        full = full or (self._ahead_bytes > 0 and self._is_tight(len(data)))
        if self._ahead_torn or full or (large and not self._ahead.keys().isdisjoint(newest)):
            self._put_in_place()  # otherwise an older entry would replace a newer one at the next opening
        if large:
            try:
                super()._store(newest)
            except OSError as error:
                raise self._cannot_write(error) from None
            return
        self._ahead_torn = True  # until it is known to be complete
        try:
            length = self._append(data)
        except OSError as error:
            if error.errno in _FULL:
                self._cut_back()
            raise self._cannot_write(error) from None
        self._ahead.update(newest)
        self._ahead_bytes += len(data)
        if length != self._ahead_bytes:
            self._put_in_place()  # another program has changed the file
        self._ahead_torn = False
        self.check()

    def _append(self, data: bytes) -> int:
        """Append to the write-ahead file; return its size."""
        with os.fdopen(self._open_file(WRITE_AHEAD, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "wb") as file:
            file.write(data)
            file.flush()
            self._sync(file.fileno(), len(data))
            length = os.fstat(file.fileno()).st_size
        if length == len(data):
            self._sync(self._handle)  # the file is new, and so is its name
        return length

    def _cut_back(self) -> None:
        """Truncate an incomplete batch at the end of the write-ahead file, so that its room is free again."""
        with suppress(OSError), os.fdopen(self._open_file(WRITE_AHEAD, os.O_WRONLY), "wb") as file:
            os.ftruncate(file.fileno(), self._ahead_bytes)
            self._ahead_torn = False

    def _is_tight(self, more_bytes: int) -> bool:
        """Return whether the disk has little more room than the written-ahead entries take in files of their own."""
        entries = self._ahead.values()
        needed = sum(len(entry.data) + 2 * _BLOCK_BYTES for entry in entries) + more_bytes + _BLOCK_BYTES
        return needed < self._ahead_bytes and _room(self._handle) < 2 * needed

    def _reserve(self) -> None:
        """Reserve some room, as far as there is any."""
        with suppress(OSError), os.fdopen(self._open_file(_RESERVE, os.O_RDWR | os.O_CREAT), "wb") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)
            self._reserved = True

    def _with_reserve(self, write: Callable[[], None]) -> None:
        """Write what must be on disk; if the disk is full, in the reserved room."""
        try:
            write()
        except OSError as error:
            if error.errno not in _FULL:
                raise
            with suppress(FileNotFoundError):
                os.unlink(_RESERVE, dir_fd=self._handle)
            self._reserved = False
            write()

    def _put_in_place(self) -> None:
        """Give each written-ahead entry a file of its own."""
        contents = {name: seal(self.uuid, entry) for name, entry in self._ahead.items()}
        try:
            self._with_reserve(lambda: self._replace(contents))
        except OSError as error:
            raise self._cannot_write(error) from None
        try:
            self._remove_ahead()
        except OSError as error:
            raise self._cannot_write(error) from None
        self._ahead, self._ahead_bytes, self._ahead_torn = {}, 0, False

    def _remove_ahead(self) -> None:
        with suppress(FileNotFoundError):
            os.unlink(WRITE_AHEAD, dir_fd=self._handle)
        self._sync(self._handle)

    def _cannot_write(self, error: OSError) -> JournalError:
        # The operating system reports the same error for a missing directory as for a missing file.
        self.check()
        return JournalError(f"the journal cannot write: {error.strerror} ({self.directory})")

    @property
    def _handle(self) -> int:
        if self._opened is None:
            raise JournalError(f"the journal in {self.directory} is closed")
        return self._opened.handle

    def _mark(self) -> str:
        # No program can set the time of a file's last change (ctime), and this file is never changed.
        with os.fdopen(self._open_file(_MARK, os.O_RDONLY | os.O_CREAT), "rb") as file:
            os.fsync(file.fileno())
            return str(os.fstat(file.fileno()).st_ctime_ns)

    def _names(self, ending: str) -> list[str]:
        return sorted(name for name in os.listdir(self._handle) if name.endswith(ending))

    def _place(self, name: str) -> str:
        # Not by pathlib, which makes Python keep each part of each path in one table for good: with names that come
        # only once, such as those of migration accounts, the table grew again and again, up to 1 MiB.
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
        except OSError:
            for name in contents:  # partly written ones take room
                with suppress(OSError):
                    os.unlink(name + _TEMPORARY, dir_fd=handle)
            raise
        for name in contents:
            os.replace(name + _TEMPORARY, name, src_dir_fd=handle, dst_dir_fd=handle)
        self._sync(handle)
        # Entries in a directory that the next start does not open are lost.
        self.check()

    def _write_temporary(self, name: str, data: bytes) -> None:
        handle = self._open_file(name + _TEMPORARY, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            self._sync(file.fileno(), len(data))

    def _rename(self, name: str, new: str) -> None:
        handle = self._handle
        os.rename(name, new, src_dir_fd=handle, dst_dir_fd=handle)
        self._sync(handle)

    def _sync(self, handle: int, written_bytes: int = 0) -> None:
        os.fsync(handle)
        self.use = DiskUse(self.use.syncs + 1, self.use.written_bytes + written_bytes)


def _room(handle: int) -> int:
    """Return how many bytes can be written to the disk of an open directory."""
    found = os.fstatvfs(handle)
    return found.f_bavail * found.f_frsize


def empty(directory: Path) -> bool:
    """Remove the journal in a state directory, and no other files.

    Returns:
        Whether there was a journal.

    Raises:
        JournalError: the directory is used by a process, or cannot be changed; the message names it.
    """
    if not directory.is_dir():
        return False
    try:
        opened = StateDirectory(directory)
        try:
            lock = _locked(opened)
            try:
                # Without an identity the rest is not valid, so a journal that is half removed is not taken for a whole
                # one.
                names = os.listdir(opened.handle)
                found = [it for it in names if SUFFIX in it or it.startswith(WRITE_AHEAD) or it == _RESERVE]
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
    """Lock a state directory for this process; return the handle that keeps the lock until it is closed."""
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
