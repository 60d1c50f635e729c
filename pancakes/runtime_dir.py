"""The runtime directory: which agents run on this machine now, for the command line to find them.

Each agent writes one small JSON file there and keeps it locked while it lives; so a file whose lock is free belongs to
an agent that has died, however that came about, and whichever process may bear its number today.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from pathlib import Path
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.malformed import MALFORMED

VARIABLE: Final = "PANCAKES_RUNTIME_DIR"
"""The environment variable that names another directory."""
_SUFFIX: Final = ".json"
_TEMPORARY: Final = ".tmp"


class Entry(msgspec.Struct, frozen=True):
    """One agent that runs on this machine.

    Attributes:
        name: its name.
        fleet: its fleet.
        role: its role, such as `agent`.
        listen: the address at which this machine reaches it; empty where it does not listen.
        pid: its process.
    """

    name: str
    fleet: str
    role: str
    listen: str
    pid: int


class Registration:
    """An agent's own entry; it stands until `remove`, or until the process ends."""

    def __init__(self, path: Path, handle: int) -> None:
        self._path = path
        self._handle: int | None = handle

    def remove(self) -> None:
        """Takes the entry away. A second call does nothing."""
        if self._handle is None:
            return
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        os.close(self._handle)  # which gives the lock back
        self._handle = None


def runtime_dir() -> Path:
    """Returns where the entries are: a directory of the user's own."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base):
        return Path(base) / "pancakes"
    return Path(f"/tmp/pancakes-{os.getuid()}")


def register(entry: Entry) -> Registration:
    """Writes an agent's entry: whoever reads finds all of it, or nothing.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """
    directory = runtime_dir()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        usable(directory)
        path = directory / f"{entry.name}.{entry.pid}{_SUFFIX}"
        temporary = path.with_name(path.name + _TEMPORARY)
        handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(handle, msgspec.json.encode(entry))
            os.replace(temporary, path)
        except BaseException:
            os.close(handle)
            raise
    except OSError as error:
        raise _unusable(directory, error) from None
    return Registration(path, handle)


def entries() -> list[Entry]:
    """Returns the agents that run on this machine, by name; what the dead left behind is cleared away.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """
    return _look()[0]


def leftovers() -> list[str]:
    """Clears away what agents left behind that died without taking their entries away.

    Returns:
        The names of these entries, `NAME.PID`.

    Raises:
        PancakesError: the directory cannot be used; the sentence says why.
    """
    return _look()[1]


def _look() -> tuple[list[Entry], list[str]]:
    """Returns the entries of those that live, by name, and the names of those that were cleared away."""
    directory = runtime_dir()
    found: list[Entry] = []
    cleared: list[str] = []
    try:
        if not directory.exists():
            return [], []
        usable(directory)
        for path in sorted(directory.iterdir()):
            if path.name.endswith((_SUFFIX, _SUFFIX + _TEMPORARY)):
                entry = _read(path, cleared)
                if entry is not None:
                    found.append(entry)
    except OSError as error:
        raise _unusable(directory, error) from None
    return sorted(found, key=lambda entry: (entry.name, entry.pid)), cleared


def usable(directory: Path) -> None:
    """Sees to it that nobody else can put an entry there, which would lead our commands to them.

    Raises:
        PancakesError: somebody could; the sentence says why.
    """
    found = os.lstat(directory)
    if not stat.S_ISDIR(found.st_mode):
        raise PancakesError(f"the runtime directory {directory} is no directory")
    if found.st_uid != os.getuid():
        raise PancakesError(f"the runtime directory {directory} belongs to another user (uid {found.st_uid})")
    if found.st_mode & 0o077:
        mode = stat.S_IMODE(found.st_mode)
        raise PancakesError(f"the runtime directory {directory} is open to other users (mode {mode:o}, not 700)")


def _read(path: Path, cleared: list[str]) -> Entry | None:
    """Returns the entry of an agent that lives; clears away that of a dead one, and notes its name."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None  # it has gone in the meantime
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            if path.name.endswith(_TEMPORARY):
                return None
            return msgspec.json.decode(os.read(handle, 65_536), type=Entry)
        path.unlink()
        cleared.append(path.name.removesuffix(_TEMPORARY).removesuffix(_SUFFIX))
    except FileNotFoundError:
        return None  # it has gone in the meantime, in order
    except MALFORMED:
        return None  # not ours
    finally:
        os.close(handle)
    return None


def _unusable(directory: Path, error: OSError) -> PancakesError:
    return PancakesError(f"the runtime directory {directory} cannot be used: {(error.strerror or str(error)).lower()}")
