"""The record of what emptied the batteries (`sim.consumption`): a row for each robot, once in a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import msgspec

from pancakes.bodies.sim.quantities import Positive
from pancakes.bodies.sim.row_file import RowFile
from pancakes.bodies.sim.state import WorldState
from pancakes.packet import SYSTEM, Packet
from pancakes.settings import FilePath
from pancakes.task import on

HEADER: Final = "t_s,name,idle_j,motion_j,sensing_j,listening_j,sending_j"
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

    header = HEADER

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
