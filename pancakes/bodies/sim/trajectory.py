"""The record of where everything really was (`sim.trajectory`): a row for each body, several times a second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pancakes.bodies.sim.quantities import Positive
from pancakes.bodies.sim.row_file import RowFile
from pancakes.bodies.sim.state import BodyState, WorldState
from pancakes.packet import SYSTEM, Packet
from pancakes.settings import FilePath
from pancakes.task import on

MOTION: Final = "%.6f,%.6f,%.6f,%.6f,%.6f"
"""Where a body is, and how fast."""
HEADER: Final = "t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"
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

    header = HEADER

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
