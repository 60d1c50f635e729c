"""The record of where everything really was (`sim.trajectory`): a row for each body, several times a second."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, TextIO

from pancakes.devices.pace import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.sim.quantities import Positive
from pancakes.sim.state import BodyState, WorldState
from pancakes.task import Task, Tick, every, on

HEADER: Final = "t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"
"""The first row."""


def row(time_s: float, body: BodyState) -> str:
    """Returns the row of a body, with fixed decimals, so that equal runs give equal files."""
    battery = "" if body.battery_v is None else f"{body.battery_v:.4f}"
    numbers = f"{body.x_m:.6f},{body.y_m:.6f},{body.theta_rad:.6f},{body.v_mps:.6f},{body.omega_radps:.6f}"
    # No minus before a zero; with all six decimals, these can only be a whole cell.
    numbers = numbers.replace("-0.000000", "0.000000")
    return f"{time_s:.3f},{body.name},{numbers},{battery},{body.driven_by}"


class Trajectory(Task):
    """Writes the world's states to a file.

    Needs the task `sim.world` on the same agent.
    """

    @dataclass
    class Settings:
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often each body gets a row, at most as often as the world publishes its state.
        """

        path: str = "trajectory.csv"
        rows_hz: Positive = 10.0

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

    @on(SYSTEM, WorldState)
    def passed(self, packet: Packet) -> None:
        """Writes the rows of one moment, when it is time."""
        state: WorldState = packet.body
        if self._file is None or not self._pace.due(state.time_s):
            return
        self._file.write("".join(f"{row(state.time_s, body)}\n" for body in state.bodies))

    @every(hz=1)
    def flush(self, tick: Tick) -> None:
        """Brings the rows to the disk, so that a mission that breaks off leaves its record."""
        if self._file is not None:
            self._file.flush()

    def _open(self) -> None:
        path = Path(self.settings.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._file.write(HEADER + "\n")
        self._file.flush()

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
