"""Record the truth of a simulation as CSV: `sim.trajectory` (where each body was), `sim.consumption` (battery use).

`RowFile` is the base class for such tasks. Numbers have fixed decimals, so equal runs give equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TextIO

import msgspec

from pancakes.devices.driver import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.settings import FilePath, Positive
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.task import Task, Tick, every, on
from pancakes.util.files import check_plain, is_still_at


class RowFile(Task):
    """Write rows to a file. A subclass passes the rows of each moment to `write`.

    It sets the header, and gives `path` and `rows_hz` their defaults.

    Attributes:
        header: the first row.
    """

    header: ClassVar[str]

    @dataclass
    class Settings:
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is overwritten.
            rows_hz: how often rows are written, at most as often as there is news.
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
        """Write the rows of one moment if it is time; `rows` is called only then."""
        if self._file is not None and self._pace.due(time_s):
            self._file.write("\n".join((*rows(), "")))

    @every(hz=1)
    def flush(self, tick: Tick) -> None:
        """Flush the rows to the disk, so that a mission that breaks off leaves its record."""
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


class WorldRecord(RowFile):
    """Write rows of the state of the simulated world. Needs the task `sim.world` on the same agent."""

    def rows(self, state: WorldState) -> Iterable[str]:
        """Return the rows of one moment, with fixed decimals, so that equal runs give equal files."""
        raise NotImplementedError

    @on(SYSTEM, WorldState)
    def record(self, packet: Packet) -> None:
        """Record one moment."""
        state: WorldState = packet.body
        self.write(state.time_s, lambda: self.rows(state))


class Trajectory(WorldRecord):
    """Write where all bodies are (`sim.trajectory`)."""

    header = "t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"

    @dataclass
    class Settings(RowFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is overwritten.
            rows_hz: how often each body gets a row, at most as often as the world publishes its state.
        """

        path: FilePath = "trajectory.csv"
        rows_hz: Positive = 10.0

    def rows(self, state: WorldState) -> Iterable[str]:
        return [trajectory_row(state.time_s, body) for body in state.bodies]


def trajectory_row(time_s: float, body: BodyState) -> str:
    numbers = f"{body.x_m:.6f},{body.y_m:.6f},{body.theta_rad:.6f},{body.v_mps:.6f},{body.omega_radps:.6f}"
    # No minus before a zero: with all six decimals it can only be a whole cell.
    numbers = numbers.replace("-0.000000", "0.000000")
    battery = "" if body.battery_v is None else f"{body.battery_v:.4f}"
    return f"{time_s:.3f},{body.name},{numbers},{battery},{body.driven_by}"


class Consumption(WorldRecord):
    """Write the energy that each robot's battery has given, by use (`sim.consumption`).

    Energies are counted from the beginning of the world.
    """

    header = "t_s,name,idle_j,motion_j,sensing_j,listening_j,sending_j"

    @dataclass
    class Settings(RowFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is overwritten.
            rows_hz: how often each robot gets a row, at most as often as the world publishes its state.
        """

        path: FilePath = "consumption.csv"
        rows_hz: Positive = 1.0

    def rows(self, state: WorldState) -> Iterable[str]:
        for body in state.bodies:
            if body.spent is not None:
                energies = ",".join(f"{energy_j:.3f}" for energy_j in msgspec.structs.astuple(body.spent))
                yield f"{state.time_s:.3f},{body.name},{energies}"
