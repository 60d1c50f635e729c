"""Record the truth of a simulation as CSV: `sim.trajectory` (where each body was), `sim.consumption` (battery use).

`RowFile` is the base class for such tasks. Numbers have fixed decimals, so equal runs give equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, TextIO

import msgspec

from pancakes.devices.driver import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.settings import FilePath
from pancakes.sim.quantities import Positive
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.task import Task, Tick, every, on
from pancakes.util.files import check_plain, is_still_at


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


MOTION: Final = "%.6f,%.6f,%.6f,%.6f,%.6f"
"""Where a body is, and how fast."""
TRAJECTORY_HEADER: Final = "t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"
"""The first row."""


def row(time_s: float, body: BodyState) -> str:
    """Returns the row of a body, with fixed decimals, so that equal runs give equal files."""
    numbers = MOTION % (body.x_m, body.y_m, body.theta_rad, body.v_mps, body.omega_radps)
    # No minus before a zero; with all six decimals, these can only be a whole cell.
    numbers = numbers.replace("-0.000000", "0.000000")
    battery = "" if body.battery_v is None else f"{body.battery_v:.4f}"
    return f"{time_s:.3f},{body.name},{numbers},{battery},{body.driven_by}"


class Trajectory(RowFile):
    """Writes where all bodies are. Needs the task `sim.world` on the same agent."""

    header = TRAJECTORY_HEADER

    @dataclass
    class Settings(RowFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often each body gets a row, at most as often as the world publishes its state.
        """

        path: FilePath = "trajectory.csv"
        rows_hz: Positive = 10.0

    @on(SYSTEM, WorldState)
    def passed(self, packet: Packet) -> None:
        """Hears of one moment."""
        state: WorldState = packet.body
        self.write(state.time_s, lambda: [row(state.time_s, body) for body in state.bodies])


CONSUMPTION_HEADER: Final = "t_s,name,idle_j,motion_j,sensing_j,listening_j,sending_j"
"""The first row. Energies are counted from the beginning of the world."""


def rows(state: WorldState) -> Sequence[str]:
    """Returns the rows of one moment, with fixed decimals, so that equal runs give equal files."""
    found = []
    for body in state.bodies:
        spent = body.spent
        if spent is not None:
            energies = msgspec.structs.astuple(spent)
            found.append(f"{state.time_s:.3f},{body.name}," + ",".join(f"{energy_j:.3f}" for energy_j in energies))
    return found


class Consumption(RowFile):
    """Writes what each robot's battery has given, and for what. Needs the task `sim.world` on the same agent."""

    header = CONSUMPTION_HEADER

    @dataclass
    class Settings(RowFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often each robot gets a row, at most as often as the world publishes its state.
        """

        path: FilePath = "consumption.csv"
        rows_hz: Positive = 1.0

    @on(SYSTEM, WorldState)
    def passed(self, packet: Packet) -> None:
        """Hears of one moment."""
        state: WorldState = packet.body
        self.write(state.time_s, lambda: rows(state))
