"""The task that keeps what is said on `log` in a file."""

from __future__ import annotations

from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from pancakes.packet import LOG, Packet
from pancakes.runtime.clock import utc_text
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.services.log_record import line_of, record_of
from pancakes.runtime.services.log_writer import LogWriter
from pancakes.runtime.services.rotated_file import RotatedFile
from pancakes.settings import FilePath

MIB: Final = 1024 * 1024
RETRY_S: Final = 5.0
"""A file that cannot be written is tried again after so long, in host time."""


class LogFile(LogWriter):
    """Writes what is said on `log` into a file, one JSON object a line.

    A file that cannot be written, as on a full disk, is told once; what is said meanwhile is not in it.
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

    @on(LOG, None, keep=queue(4096))
    def write(self, packet: Packet) -> None:
        """Writes one line, or counts it."""
        self.write_some(packet)

    def put(self, packet: Packet) -> int:
        broken_until_s = self._broken_until_s
        if broken_until_s is not None and self.kernel.host.now() < broken_until_s:
            self._missing += 1
            return 0
        record, utc_s = record_of(packet), self.kernel.utc_s(packet.stamp)
        line = line_of(record if utc_s is None else {**record, "utc": utc_text(utc_s)})
        try:
            self._file.write(line)
        except OSError as error:
            self._missing += 1
            self._broken_until_s = self.kernel.host.now() + RETRY_S
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
