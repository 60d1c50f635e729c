"""Whether a file is still the one that was read."""

from __future__ import annotations

from pathlib import Path

from pancakes.runtime.foundation.digest import sha256


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
        """Returns whether it says something else by now, or is gone."""
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
