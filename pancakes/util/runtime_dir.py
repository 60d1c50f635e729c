"""The runtime directory: the agents that run on this machine, so that the command line finds them.

Each agent writes one small JSON file there and keeps it locked while it lives. A file whose lock is free belongs to
an agent that has died, even if another process has its number now. The directory must be closed to
other users, because our commands connect to what it names.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
import sys
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.util import codecs
from pancakes.util.clock import wall_ns
from pancakes.util.codecs import MALFORMED
from pancakes.util.text import printable

VARIABLE: Final = "PANCAKES_RUNTIME_DIR"
"""The environment variable that sets another directory."""
LOOK_S: Final = 5.0
"""How often an agent checks that its entry is still there, in seconds."""
_SUFFIX: Final = ".json"
_TEMPORARY: Final = ".tmp"
_NAME: Final = re.compile(r".+\.\d+\.json(\.tmp)?", re.DOTALL)
"""Agents write files with these names: `NAME.PID.json`."""
_WRITTEN_S: Final = 60.0
"""A temporary file that is younger than this, in seconds, is kept: its agent may be about to lock it."""
_LIMIT_BYTES: Final = 65_536
_KINDS: Final = {
    stat.S_IFDIR: "a directory",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a block device",
    stat.S_IFCHR: "a character device",
}


class RunningAgent(msgspec.Struct, frozen=True):
    """One agent that runs on this machine.

    Attributes:
        name: its name.
        fleet: its fleet.
        role: its role, such as `agent`.
        listen: the addresses at which this machine reaches it, the best first; none if it does not listen.
        pid: its process.
    """

    name: str
    fleet: str
    role: str
    listen: tuple[str, ...]
    pid: int


_DECODE: Final = codecs.json_decoder(RunningAgent)


class Registration:
    """An agent's own entry; it stays until `remove`, or until the process ends.

    Args:
        entry: its contents.
        group: members of this group may read it too; empty: only its user.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """

    def __init__(self, entry: RunningAgent, group: str = "") -> None:
        self._entry = entry
        self._group = group
        self._path = runtime_dir() / f"{entry.name}.{entry.pid}{_SUFFIX}"
        self._handle: int | None = self._write()

    def renew(self) -> bool:
        """Write the entry again if it is gone: a session's directory ends with the session.

        Returns:
            Whether it was gone and is written again.
        """
        if self._handle is None or is_at(self._path, os.fstat(self._handle)):
            return False
        try:
            handle = self._write()
        except PancakesError:
            return False  # the directory comes back with the next session
        os.close(self._handle)
        self._handle = handle
        return True

    def remove(self) -> None:
        """Remove the entry. A second call does nothing."""
        if self._handle is None:
            return
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        os.close(self._handle)  # this releases the lock
        self._handle = None

    def _write(self) -> int:
        """Write the entry atomically. Return the file, open and locked."""
        directory = self._path.parent
        try:
            make_directory(directory, self._group)
            temporary = self._path.with_name(self._path.name + _TEMPORARY)
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self._group:
                    open_to(handle, self._group, 0o640)
                os.write(handle, codecs.encode_json(self._entry))
                os.replace(temporary, self._path)
            except BaseException:
                os.close(handle)
                raise
        except OSError as error:
            raise _unusable(directory, error) from None
        return handle


def runtime_dir() -> Path:
    """Return the directory with the entries, which belongs to the user."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base):
        return Path(base) / "pancakes"
    return Path(f"/tmp/pancakes-{os.getuid()}")


class Found(msgspec.Struct, frozen=True):
    """The contents of the runtime directory.

    Attributes:
        entries: the agents that run on this machine, by name.
        cleared: the entries of agents that died without removing them, as `NAME.PID`; they have just been removed.
        odd: a sentence for each other thing in it; it is not changed.
    """

    entries: list[RunningAgent]
    cleared: list[str]
    odd: list[str]


def why_none(fleet: str) -> str:
    """Return the sentence that no agent of a fleet runs on this machine, with the fleets that do.

    Args:
        fleet: the fleet; empty: any.

    Raises:
        PancakesError: see `entries`.
    """
    of = f" of the fleet {fleet}" if fleet else ""
    others = other_fleets(fleet)
    names = f"has only the fleet{'s' if len(others) > 1 else ''} {', '.join(others)}" if others else "names none"
    return f"no agent{of} runs on this machine ({runtime_dir()} {names})"


def other_fleets(fleet: str) -> list[str]:
    """Return the other fleets with agents on this machine.

    Raises:
        PancakesError: see `entries`.
    """
    return sorted({entry.fleet for entry in entries() if entry.role != "client"} - {fleet})


def entries() -> list[RunningAgent]:
    """Return the agents that run on this machine, by name; entries of dead agents are removed.

    Other things in it are ignored, with a warning on standard error, once in a process.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """
    found = look()
    for sentence in found.odd:
        _warn(sentence)
    return found.entries


@cache
def _warn(sentence: str) -> None:
    print(f"warning: {sentence}; ignored", file=sys.stderr)


def look() -> Found:
    """Read the runtime directory, and remove the entries of dead agents.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """
    directory = runtime_dir()
    found = Found([], [], [])
    try:
        if not directory.exists():
            return found
        usable(directory)
        for path in sorted(directory.iterdir()):
            if path.name.endswith((_SUFFIX, _SUFFIX + _TEMPORARY)):
                try:
                    _read(path, found)
                except FileNotFoundError:
                    pass  # it has been removed meanwhile
                except OSError as error:
                    why = (error.strerror or str(error)).lower()
                    found.odd.append(f"{printable(str(path))} cannot be read: {why}")
    except OSError as error:
        raise _unusable(directory, error) from None
    found.entries.sort(key=lambda entry: (entry.name, entry.pid))
    return found


def make_directory(directory: Path, group: str = "") -> None:
    """Make a directory in which no other user can write, if it is missing.

    Args:
        directory: the directory; missing parents are made too.
        group: members of this group may read what is in it; empty: only its user.

    Raises:
        PancakesError: another user could write there, or the group does not exist; the sentence says why.
        OSError: the operating system refuses.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    usable(directory)
    if group:
        open_to(directory, group, 0o750)


def is_at(path: Path, made: os.stat_result) -> bool:
    """Return whether a path still leads to the file that was made there."""
    try:
        there = os.lstat(path)
    except OSError:
        return False
    return (there.st_ino, there.st_dev) == (made.st_ino, made.st_dev)


def open_to(path: int | Path, group: str, mode: int) -> None:
    """Give a group access to a file, by path or descriptor.

    Raises:
        PancakesError: there is no such group; the sentence says so.
        OSError: this user may not: it is not a member of the group.
    """
    import grp

    try:
        number = grp.getgrnam(group).gr_gid
    except (KeyError, ValueError):  # ValueError: a NUL is in it
        raise PancakesError(f"the group {group!r} of [agent] local_group does not exist on this machine") from None
    if os.stat(path).st_gid != number:
        os.chown(path, -1, number)
    os.chmod(path, mode)


def usable(directory: Path, named: bool = False) -> None:
    """Check that no other user can write there: an entry could lead our commands to that user's programs.

    A directory of another user is used only if a person named it: agents that run as a system service are there, and
    people of their group look for them there.

    Args:
        directory: the directory.
        named: whether it was named, but not by `PANCAKES_RUNTIME_DIR`.

    Raises:
        PancakesError: another user could; the sentence says why.
    """
    found = os.lstat(directory)
    if not stat.S_ISDIR(found.st_mode):
        raise PancakesError(f"the runtime directory {directory} is not a directory")
    variable = os.environ.get(VARIABLE)
    named = named or (bool(variable) and directory.is_relative_to(variable or ""))
    if found.st_uid != os.getuid() and not named:
        raise PancakesError(f"the runtime directory {directory} belongs to another user (uid {found.st_uid})")
    if found.st_mode & 0o027:
        mode = stat.S_IMODE(found.st_mode)
        raise PancakesError(
            f"the runtime directory {directory} is open to other users (mode {mode:o}, not 700, or 750 for one group)"
        )


def _read(path: Path, found: Found) -> None:
    """Read one entry. Whatever it is, this does not block, and reads no more than the size of an entry.

    Raises:
        OSError: it cannot be opened.
    """
    owner = os.stat(path.parent).st_uid
    status = os.lstat(path)
    oddity = _oddity(status, owner)
    if not oddity and path.name.endswith(_TEMPORARY) and abs(wall_ns() / 1e9 - status.st_mtime) < _WRITTEN_S:
        return  # even testing its lock could block its agent
    if oddity:
        found.odd.append(f"{printable(str(path))} is {oddity}, no agent's entry")
        return
    # Its type may have changed since: opening a FIFO would wait for a writer.
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        oddity = _oddity(os.fstat(handle), owner)
        lives = not oddity and is_locked(handle)
        if lives and path.name.endswith(_TEMPORARY):
            return  # it is being written
        if lives:
            try:
                found.entries.append(_DECODE(os.read(handle, _LIMIT_BYTES)))
                return
            except MALFORMED:
                oddity = "in use, but its contents are"
        elif not oddity and _NAME.fullmatch(path.name):
            if os.fstat(handle).st_uid != os.getuid():
                return  # its own user removes it
            path.unlink()
            found.cleared.append(path.name.removesuffix(_TEMPORARY).removesuffix(_SUFFIX))
            return
        found.odd.append(f"{printable(str(path))} is {oddity or 'a file of another kind,'} no agent's entry")
    finally:
        os.close(handle)


def _oddity(status: os.stat_result, owner: int) -> str:
    """Return why a thing is not an entry, as a phrase; empty: it may be one."""
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        return _KINDS.get(kind, "no file")
    if status.st_uid not in (os.getuid(), owner):
        return f"a file of another user (uid {status.st_uid})"
    if status.st_size > _LIMIT_BYTES:
        return f"a file of {status.st_size} bytes"
    return ""


def is_locked(file: int | BinaryIO) -> bool:
    """Return whether another process has the lock on a file."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


def _unusable(directory: Path, error: OSError) -> PancakesError:
    what = (error.strerror or str(error)).lower()
    if error.filename is not None and Path(os.fsdecode(error.filename)) != directory:
        what = f"{printable(os.fsdecode(error.filename))}: {what}"
    return PancakesError(f"the runtime directory {directory} cannot be used: {what}")
