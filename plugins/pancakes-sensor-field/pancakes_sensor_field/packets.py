"""The packets of the tasks and devices of a sensor field."""

from __future__ import annotations

import msgspec

from pancakes import packet_type
from pancakes.sim.world_state import Spent


@packet_type("sensor_field.line")
class LineReport(msgspec.Struct, frozen=True):
    """How well the tiny nodes of a line are heard: a reading of its device. It counts from the device's start.

    Attributes:
        connected: whether the line is open.
        frames: frames that came complete.
        crc_errors: how often a frame began whose CRC was wrong.
        skipped_bytes: bytes that did not belong to a frame.
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
    """A request for another report period; sent on `system` to the device of the tiny nodes' line.

    Attributes:
        period_s: seconds between two reports, 0.1 to 3276.7.
        node: which one; empty: all on that line.
    """

    period_s: float
    node: str = ""


@packet_type("sensor_field.siren")
class Siren(msgspec.Struct, frozen=True):
    """A command to the siren of a tiny node."""

    sounds: bool


@packet_type("sensor_field.activity")
class Activity(msgspec.Struct, frozen=True):
    """Whether something happens at a node."""

    node: str
    busy: bool


@packet_type("sensor_field.report")
class Report(msgspec.Struct, frozen=True):
    """The report of a node to the alarm.

    Attributes:
        node: the node.
        number: the number of its reports, this one included.
        celsius: its temperature; None if it has not measured any yet.
        moving: whether something moves before it.
    """

    node: str
    number: int
    celsius: float | None
    moving: bool


@packet_type("sensor_field.alarm_raised")
class AlarmRaised(msgspec.Struct, frozen=True):
    """An alarm in the field.

    Attributes:
        number: the alarm's number, from 1.
        weight: the weight of the evidence.
        moving: nodes that have sensed motion.
        hot: nodes that are hot.
    """

    number: int
    weight: float
    moving: tuple[str, ...]
    hot: tuple[str, ...]


@packet_type("sensor_field.alarm_cleared")
class AlarmCleared(msgspec.Struct, frozen=True):
    """The end of an alarm."""

    number: int


class NodeTruth(msgspec.Struct, frozen=True):
    """The true state of a node of a simulated field.

    Attributes:
        name: the node.
        celsius: the temperature where it stands.
        moving: whether something moves before it.
        level: what is left of its battery, 0 to 1; None if its battery is not simulated.
        listening: whether its radio is on.
        spent: the energy that its battery has given; None if it is not simulated.
    """

    name: str
    celsius: float
    moving: bool
    level: float | None = None
    listening: bool = True
    spent: Spent | None = None


@packet_type("sensor_field.truth")
class FieldTruth(msgspec.Struct, frozen=True):
    """The true state of a simulated field at one moment of mission time, for the tasks of its own agent."""

    time_s: float
    nodes: tuple[NodeTruth, ...]
