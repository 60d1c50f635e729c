"""Record the true state of a simulated field (`sensor_field.FieldRecord`): a row for each node, each second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pancakes import SYSTEM, FilePath, Packet, Positive, on
from pancakes.sim.csv_records import RowFile
from pancakes_sensor_field.packets import FieldTruth, NodeTruth

HEADER: Final = "t_s,node,celsius,moving,level,radio,idle_j,sensing_j,listening_j,sending_j"
"""The first row. The battery's columns are empty for a node whose battery does not count."""


def row(time_s: float, node: NodeTruth) -> str:
    """Return the row of a node, with fixed decimals, so that equal runs give equal files."""
    battery = "," * 5
    if node.level is not None and node.spent is not None:
        spent = node.spent
        joules = (spent.idle_j, spent.sensing_j, spent.listening_j, spent.sending_j)
        battery = f"{node.level:.5f},{int(node.listening)},{','.join(f'{energy_j:.4f}' for energy_j in joules)}"
    return f"{time_s:.3f},{node.name},{node.celsius:.3f},{int(node.moving)},{battery}"


class FieldRecord(RowFile):
    """Write the state of a field to a file. Needs the task `sensor_field.Field` on the same agent."""

    header = HEADER

    @dataclass
    class Settings(RowFile.Settings):
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is overwritten when the task starts.
            rows_hz: how often each node gets a row.
        """

        path: FilePath = "field.csv"
        rows_hz: Positive = 1.0

    settings: Settings

    @on(SYSTEM, FieldTruth)
    def passed(self, packet: Packet) -> None:
        """Record one moment."""
        truth: FieldTruth = packet.body
        self.write(truth.time_s, lambda: [row(truth.time_s, node) for node in truth.nodes])
