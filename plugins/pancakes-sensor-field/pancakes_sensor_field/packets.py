"""What the tasks and devices of a sensor field say to each other."""

from __future__ import annotations

import msgspec

from pancakes.packet import packet_type
from pancakes.sim.world_state import Spent


@packet_type("sensor_field.line")
class LineReport(msgspec.Struct, frozen=True):
    """How well the tiny nodes of a line are heard: a reading of such a device. It counts from the device's start.

    Attributes:
        connected: whether the line is there.
        frames: frames that came whole.
        crc_errors: how often a frame began whose CRC was wrong.
        skipped_bytes: bytes that belonged to no frame.
        missed: frames that never came.
        repeated: frames that came twice, or too late.
        unknown: frames of nodes that the settings do not name, or of an unknown kind.
    """

    connected: bool
    frames: int
    crc_errors: int
    skipped_bytes: int
    missed: int
    repeated: int
    unknown: int


@packet_type("sensor_field.report_period")
class ReportPeriod(msgspec.Struct, frozen=True):
    """Ask tiny nodes to report in another period; sent on `system` to the device of their line.

    Attributes:
        period_s: seconds between two reports, 0.1 to 3276.7.
        node: which one; empty: all of that line.
    """

    period_s: float
    node: str = ""


@packet_type("sensor_field.siren")
class Siren(msgspec.Struct, frozen=True):
    """A command to the siren of a tiny node."""

    sounds: bool


@packet_type("sensor_field.activity")
class Activity(msgspec.Struct, frozen=True):
    """Something happens at a node, or no more."""

    node: str
    busy: bool


@packet_type("sensor_field.report")
class Report(msgspec.Struct, frozen=True):
    """What a node tells the alarm.

    Attributes:
        node: the node.
        number: how many reports it has made with this one.
        celsius: its temperature; None where it has not measured any yet.
        moving: whether something moves before it.
    """

    node: str
    number: int
    celsius: float | None
    moving: bool


@packet_type("sensor_field.alarm_raised")
class AlarmRaised(msgspec.Struct, frozen=True):
    """The field is alarmed.

    Attributes:
        number: the alarm's number, from 1.
        weight: what the evidence weighs.
        moving: nodes that have sensed motion.
        hot: nodes that are hot.
    """

    number: int
    weight: float
    moving: tuple[str, ...]
    hot: tuple[str, ...]


@packet_type("sensor_field.alarm_cleared")
class AlarmCleared(msgspec.Struct, frozen=True):
    """All is quiet again after an alarm."""

    number: int


class NodeTruth(msgspec.Struct, frozen=True):
    """How a node of a simulated field really fares.

    Attributes:
        name: the node.
        celsius: the temperature where it stands.
        moving: whether something moves before it.
        level: what is left of its battery, 0 to 1; None where it has none that counts.
        listening: whether its radio is on.
        spent: what its battery has given; None where it has none that counts.
    """

    name: str
    celsius: float
    moving: bool
    level: float | None = None
    listening: bool = True
    spent: Spent | None = None


@packet_type("sensor_field.truth")
class FieldTruth(msgspec.Struct, frozen=True):
    """How a simulated field really is at one moment of mission time, as it tells the tasks of its own agent."""

    time_s: float
    nodes: tuple[NodeTruth, ...]
