"""The log file: a task that writes what is said on `log` as JSON lines, into files of bounded size.

When a file is full it becomes FILE.1, and so on; the oldest is removed. The file is opened again after an error, and
if another program has moved it, as logrotate does. Imported only if a log file is configured.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from io import TextIOWrapper
from logging import LogRecord, makeLogRecord
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from pancakes.events import line_of, record_of
from pancakes.kernel.handlers import on
from pancakes.packet import LOG, Packet
from pancakes.services.log_writer import LogWriter
from pancakes.settings import FilePath
from pancakes.util.clock import utc_text
from pancakes.util.files import check_plain, is_still_at


class RotatedFile:
    """Lines are appended to `path`; once it is full, it becomes `path.1`, that one `path.2`, and so on.

    Each line is handed to the operating system at once, and a file is put aside only by renaming it, so a process
    that is killed loses nothing. A file is opened when the first line is written, and again after an error, or if
    another program has moved or removed it meanwhile, as logrotate does.

    Args:
        path: the file; its directory is made.
        limit_bytes: its largest size; a single line that is larger is written whole.
        files: how many are kept, with the one being written; at least 2.
        moved: called before a new file begins in the place of one that has been moved or removed.
    """

    def __init__(self, path: str, limit_bytes: int, files: int, moved: Callable[[], None] = lambda: None) -> None:
        self._moved = moved
        self._handler = _Handler(
            path, "a", limit_bytes, files - 1, encoding="utf-8", delay=True, errors="backslashreplace"
        )

    def write(self, line: str) -> None:
        """Append one line.

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
        """Close the file.

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
        """Return whether what is written is no longer the file of this name."""
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


MIB: Final = 1024 * 1024
RETRY_S: Final = 5.0
"""After this time, in host time, a file that could not be written is tried again."""


class LogFile(LogWriter):
    """Writes what is said on `log` into a file, one JSON object a line.

    A file that cannot be written, as on a full disk, is reported once; lines that come meanwhile are not in it.
    """

    class Settings(msgspec.Struct):
        """Where to, and how much; see `LogService.Settings`."""

        path: FilePath
        limit_mib: Annotated[float, Meta(gt=0.0)]
        files: Annotated[int, Meta(ge=2, le=1000)]
        share_kib_s: Annotated[float, Meta(ge=0.0)]

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._file = self._open()
        self._broken_until_s: float | None = None
        self._missing = 0

    def _open(self) -> RotatedFile:
        settings = self.settings
        return RotatedFile(settings.path, max(1, int(settings.limit_mib * MIB)), settings.files, self._was_moved)

    def _was_moved(self) -> None:
        path = self.settings.path
        self.log("warning", f"the log file {path} was moved or removed by another program: a new one begins")

    @on(LOG, None, queue=4096)
    def write(self, packet: Packet) -> None:
        """Write one line, or count it."""
        self.write_some(packet)

    def put(self, packet: Packet) -> int:
        broken_until_s = self._broken_until_s
        if broken_until_s is not None and self._actor.kernel.host.now() < broken_until_s:
            self._missing += 1
            return 0
        record, utc_s = record_of(packet), self._actor.kernel.utc_s(packet.stamp_s)
        line = line_of(record if utc_s is None else {**record, "utc": utc_text(utc_s)})
        try:
            self._file.write(line)
        except OSError as error:
            self._missing += 1
            self._broken_until_s = self._actor.kernel.host.now() + RETRY_S
            if broken_until_s is None:
                self.log(
                    "error",
                    f"the log file {self.settings.path} cannot be written: {error.strerror or error};"
                    f" it is tried again every {RETRY_S:g} s, and what is said until then will be missing in it",
                )
            return 0
        if broken_until_s is not None:
            missing, self._missing, self._broken_until_s = self._missing, 0, None
            self.log("warning", f"the log file {self.settings.path} is written again; {missing:,} lines are missing")
        return len(line)

    def on_settings(self) -> None:
        super().on_settings()
        self._close()
        self._file = self._open()

    def on_stop(self) -> None:
        super().on_stop()
        self._close()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self._close()

    def _close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            reason = error.strerror or error
            self.log("error", f"the end of the log file {self.settings.path} was not written: {reason}")
