"""The record of how a simulated field really was (`sensor_field.FieldRecord`): a row for each node, each second."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, TextIO

from pancakes.devices.pace import Pace
from pancakes.packet import SYSTEM, Packet
from pancakes.sim.quantities import Positive
from pancakes.task import Task, Tick, every, on
from pancakes_sensor_field.packets import FieldTruth, NodeTruth

HEADER: Final = "t_s,node,celsius,moving,level,radio,idle_j,sensing_j,listening_j,sending_j"
"""The first row. The battery's columns are empty for a node whose battery does not count."""


def row(time_s: float, node: NodeTruth) -> str:
    """Returns the row of a node, with fixed decimals, so that equal runs give equal files."""
    battery = "," * 5
    if node.level is not None and node.spent is not None:
        spent = node.spent
        joules = (spent.idle_j, spent.sensing_j, spent.listening_j, spent.sending_j)
        battery = f"{node.level:.5f},{int(node.listening)},{','.join(f'{energy_j:.4f}' for energy_j in joules)}"
    return f"{time_s:.3f},{node.name},{node.celsius:.3f},{int(node.moving)},{battery}"


class FieldRecord(Task):
    """Writes how a field is to a file. Needs the task `sensor_field.Field` on the same agent."""

    @dataclass
    class Settings:
        """Where to, and how often.

        Attributes:
            path: the file; one that exists is written anew when the task starts.
            rows_hz: how often each node gets a row.
        """

        path: str = "field.csv"
        rows_hz: Positive = 1.0

    settings: Settings
    _file: TextIO | None = None

    def on_start(self) -> None:
        self._pace = Pace(self.settings.rows_hz)
        self._open()

    def on_stop(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def on_settings(self) -> None:
        self._pace = Pace(self.settings.rows_hz)
        if self._file is not None and self._file.name != self.settings.path:
            self.on_stop()
            self._open()

    @on(SYSTEM, FieldTruth)
    def passed(self, packet: Packet) -> None:
        """Writes the rows of one moment, when it is time."""
        truth: FieldTruth = packet.body
        if self._file is not None and self._pace.due(truth.time_s):
            self._file.write("".join(f"{row(truth.time_s, node)}\n" for node in truth.nodes))

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
