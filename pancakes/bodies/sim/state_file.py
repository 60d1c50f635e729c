"""The base of tasks that write what the world tells of its bodies to a file."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from pancakes.bodies.sim.row_file import RowFile
from pancakes.bodies.sim.state import WorldState
from pancakes.packet import SYSTEM, Packet
from pancakes.task import on


class StateFile(RowFile):
    """Writes rows about the world's states to a file. Needs the task `sim.world` on the same agent."""

    @abstractmethod
    def rows(self, state: WorldState) -> Sequence[str]:
        """Returns the rows of one moment, with fixed decimals, so that equal runs give equal files."""

    @on(SYSTEM, WorldState)
    def passed(self, packet: Packet) -> None:
        """Hears of one moment."""
        state: WorldState = packet.body
        self.write(state.time_s, lambda: self.rows(state))
