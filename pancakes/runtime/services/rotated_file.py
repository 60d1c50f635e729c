"""A text file of bounded size: once it is full it is put aside, and the oldest of those put aside is removed."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from io import TextIOWrapper
from logging import LogRecord, makeLogRecord
from logging.handlers import RotatingFileHandler
from pathlib import Path

from pancakes.runtime.foundation.plain_file import check_plain
from pancakes.runtime.foundation.same_file import is_still_at


class RotatedFile:
    """Lines are appended to `path`; once it is full, it becomes `path.1`, that one `path.2`, and so on.

    Each line is handed to the operating system at once, and a file is put aside by its name alone, so a process that is
    killed loses nothing. A file is opened when the first line is written, and again after an error, and where another
    program has moved or removed it meanwhile, as logrotate does.

    Args:
        path: the file; its directory is made.
        limit_bytes: so large it becomes, at most; a single line that is larger is written whole.
        files: so many are kept, the one that is written among them; at least 2.
        moved: called before a new file begins in the place of one that has been moved or removed.
    """

    def __init__(self, path: str, limit_bytes: int, files: int, moved: Callable[[], None] = lambda: None) -> None:
        self._moved = moved
        self._handler = _Handler(
            path, "a", limit_bytes, files - 1, encoding="utf-8", delay=True, errors="backslashreplace"
        )

    def write(self, line: str) -> None:
        """Appends one line.

        Raises:
            OSError: it cannot be written; the line is lost.
        """
        try:
            if self._handler.is_elsewhere():
                self._handler.close()
                self._moved()
            self._handler.emit(makeLogRecord({"msg": line}))
        except OSError:
            with suppress(OSError):
                self._handler.close()
            raise

    def close(self) -> None:
        """Closes the file.

        Raises:
            OSError: the last of it could not be written.
        """
        self._handler.close()


class _Handler(RotatingFileHandler):
    """As the library's, but errors are raised, and a line that a crash has torn does not spoil the next one."""

    def _open(self) -> TextIOWrapper:
        Path(self.baseFilename).parent.mkdir(parents=True, exist_ok=True)
        check_plain(self.baseFilename)
        file = super()._open()
        if self._is_torn():
            file.write(self.terminator)
        return file

    def is_elsewhere(self) -> bool:
        """Returns whether what is written is no longer the file of this name."""
        return self.stream is not None and not is_still_at(self.stream.fileno(), self.baseFilename)

    def _is_torn(self) -> bool:
        with suppress(OSError):  # it is empty, say
            if stat.S_ISREG(os.stat(self.baseFilename).st_mode):
                with open(self.baseFilename, "rb") as file:
                    file.seek(-1, os.SEEK_END)
                    return file.read(1) != b"\n"
        return False

    def shouldRollover(self, record: LogRecord) -> bool:
        # An empty file is not put aside for a line that is larger than all of it; Python 3.11 would.
        return bool(super().shouldRollover(record)) and self.stream is not None and self.stream.tell() > 0

    def handleError(self, record: LogRecord) -> None:
        raise
