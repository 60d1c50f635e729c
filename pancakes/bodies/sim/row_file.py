"""The base of tasks that write a simulation's truth to a file: rows, several times a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TextIO

from pancakes.bodies.devices.pace import Pace
from pancakes.bodies.sim.quantities import Positive
from pancakes.runtime.foundation.plain_file import check_plain
from pancakes.runtime.foundation.same_file import is_still_at
from pancakes.settings import FilePath
from pancakes.task import Task, Tick, every


class RowFile(Task):
    """Writes rows to a file. A subclass hears of each moment, and hands its rows to `write`.

    It gives `path` and `rows_hz` their defaults.

    Attributes:
        header: the first row.
    """

    header: ClassVar[str]

    @dataclass
    class Settings:
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often there are rows, at most as often as there is news.
        """

        path: FilePath
        rows_hz: Positive

    settings: Settings
    _file: TextIO | None = None

    def on_start(self) -> None:
        self._pace = Pace(self.settings.rows_hz)
        self._open()

    def on_stop(self) -> None:
        self._close()

    def on_settings(self) -> None:
        self._pace = Pace(self.settings.rows_hz)
        if self._file is not None and self._file.name != self.settings.path:
            self._close()
            self._open()

    def write(self, time_s: float, rows: Callable[[], Iterable[str]]) -> None:
        """Writes the rows of one moment, when it is time; `rows` is asked only then."""
        if self._file is not None and self._pace.due(time_s):
            self._file.write("\n".join((*rows(), "")))

    @every(hz=1)
    def flush(self, tick: Tick) -> None:
        """Brings the rows to the disk, so that a mission that breaks off leaves its record."""
        if self._file is None:
            return
        self._file.flush()
        if not is_still_at(self._file.fileno(), self._file.name):
            path = self.settings.path
            self.log("warning", f"{path} was moved or removed by another program: a new file begins")
            self._close()
            self._open()

    def _open(self) -> None:
        path = Path(self.settings.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        check_plain(path)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._file.write(self.header + "\n")
        self._file.flush()

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
