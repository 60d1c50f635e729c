"""The record of where everything really was (`sim.trajectory`): a row for each body, several times a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pancakes.sim.quantities import Positive
from pancakes.sim.state import BodyState, WorldState
from pancakes.sim.state_file import StateFile

HEADER: Final = "t_s,name,x_m,y_m,theta_rad,v_mps,omega_radps,battery_v,driven_by"
"""The first row."""


_Motion = tuple[float, float, float, float, float]
_NUMBERS: Final = "%.6f,%.6f,%.6f,%.6f,%.6f"  # a quarter faster than the same as an f-string


def row(time_s: float, body: BodyState) -> str:
    """Returns the row of a body, with fixed decimals, so that equal runs give equal files."""
    return _row(f"{time_s:.3f}", body, _numbers(_motion(body)))


def _row(time: str, body: BodyState, numbers: str) -> str:
    battery = "" if body.battery_v is None else f"{body.battery_v:.4f}"
    return f"{time},{body.name},{numbers},{battery},{body.driven_by}"


def _motion(body: BodyState) -> _Motion:
    return body.x_m, body.y_m, body.theta_rad, body.v_mps, body.omega_radps


def _numbers(motion: _Motion) -> str:
    # No minus before a zero; with all six decimals, these can only be a whole cell.
    return (_NUMBERS % motion).replace("-0.000000", "0.000000")


class Trajectory(StateFile):
    """Writes where all bodies are. Needs the task `sim.world` on the same agent."""

    header = HEADER

    @dataclass
    class Settings(StateFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew.
            rows_hz: how often each body gets a row, at most as often as the world publishes its state.
        """

        path: str = "trajectory.csv"
        rows_hz: Positive = 10.0

    def on_start(self) -> None:
        self._last: dict[str, tuple[_Motion, str]] = {}  # of many bodies at one moment, most stand where they stood
        super().on_start()

    def rows(self, state: WorldState) -> Sequence[str]:
        time, last = f"{state.time_s:.3f}", self._last
        rows = []
        for body in state.bodies:
            motion = _motion(body)
            known = last.get(body.name)
            if known is None or known[0] != motion:
                known = last[body.name] = (motion, _numbers(motion))
            rows.append(_row(time, body, known[1]))
        return rows
