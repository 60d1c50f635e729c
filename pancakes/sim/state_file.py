"""The base of tasks that write what the world tells of its bodies to a file: rows, several times a second."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TextIO

from pancakes.devices.pace import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.sim.quantities import Positive
from pancakes.sim.state import WorldState
from pancakes.task import Task, Tick, every, on


class StateFile(Task):
    """Writes rows about the world's states to a file. Needs the task `sim.world` on the same agent.

    A subclass says what a row is, and gives `path` and `rows_hz` their defaults.

    Attributes:
        header: the first row.
    """

    header: ClassVar[str]

    @dataclass
    class Settings:
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often each body gets a row, at most as often as the world publishes its state.
        """

        path: str
        rows_hz: Positive

    settings: Settings
    _file: TextIO | None = None

    @abstractmethod
    def rows(self, state: WorldState) -> Sequence[str]:
        """Returns the rows of one moment, with fixed decimals, so that equal runs give equal files."""

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

    @on(SYSTEM, WorldState)
    def passed(self, packet: Packet) -> None:
        """Writes the rows of one moment, when it is time."""
        state: WorldState = packet.body
        if self._file is None or not self._pace.due(state.time_s):
            return
        self._file.write("".join(f"{row}\n" for row in self.rows(state)))

    @every(hz=1)
    def flush(self, tick: Tick) -> None:
        """Brings the rows to the disk, so that a mission that breaks off leaves its record."""
        if self._file is not None:
            self._file.flush()

    def _open(self) -> None:
        path = Path(self.settings.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._file.write(self.header + "\n")
        self._file.flush()

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
