"""Devices: the packet types of readings and commands (`Pose`, `Twist`, `Battery`, ...). Drivers are in `driver.py`.

A device's type, the type of its packets and the word in a task's `requires` are the same name: a `pose` device
publishes `pose` packets on `system`; a `motors` device takes `motors` packets from `ctrl`. Lengths are metres, angles
are radians counter-clockwise, times are seconds.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from pancakes.devices.validation import MaybeNan
from pancakes.packet import packet_type


@packet_type("pose")
class Pose(msgspec.Struct, frozen=True):
    """Where a body is, in the frame of the world.

    Attributes:
        x_m: position along the world's x axis.
        y_m: position along the world's y axis.
        theta_rad: heading, in (-pi, pi], counter-clockwise from the x axis.
    """

    x_m: float
    y_m: float
    theta_rad: float


@packet_type("motors")
class Twist(msgspec.Struct, frozen=True):
    """A command to a drive, in the frame of the body.

    Attributes:
        v_mps: forward speed.
        omega_radps: turning rate, counter-clockwise.
    """

    v_mps: float
    omega_radps: float


@packet_type("battery")
class Battery(msgspec.Struct, frozen=True):
    """The state of a battery.

    Attributes:
        voltage_v: voltage at the terminals; NaN: it is not known.
        level: what is left of its range, from 0 (empty) to 1 (full).
    """

    voltage_v: MaybeNan
    level: Annotated[float, msgspec.Meta(ge=0, le=1)]


@packet_type("ir")
class Infrared(msgspec.Struct, frozen=True):
    """One sweep of a ring of infrared proximity sensors. One that measures nothing now is left out of it.

    Attributes:
        bearings_rad: direction of each sensor, in the frame of the body.
        ranges_m: distance from the edge of each sensor to what it sees; its full range where it sees nothing.
        max_range_m: the full range.
        raw: what the sensor itself says, in its own units, one for each.
    """

    bearings_rad: tuple[float, ...]
    ranges_m: tuple[float, ...]
    max_range_m: float
    raw: tuple[int, ...] = ()


@packet_type("sonar")
class Sonar(msgspec.Struct, frozen=True):
    """One sweep of a ring of sonars. One that measures nothing now is left out of it.

    Attributes:
        bearings_rad: direction of each sonar, in the frame of the body.
        ranges_m: distance from each sonar to what it hears; its full range where it hears nothing.
        max_range_m: the full range.
    """

    bearings_rad: tuple[float, ...]
    ranges_m: tuple[float, ...]
    max_range_m: float


@packet_type("motion")
class Motion(msgspec.Struct, frozen=True):
    """What a motion sensor says.

    Attributes:
        detected: whether something moves in its field of view.
        bearing_rad: direction of the nearest thing that moves, in the frame of the sensor's body; None where
            the sensor cannot tell.
        range_m: distance to it from the sensor's centre; None where the sensor cannot tell.
    """

    detected: bool
    bearing_rad: float | None = None
    range_m: float | None = None


@packet_type("load")
class Load(msgspec.Struct, frozen=True):
    """How busy a computer is.

    Attributes:
        cpu: share of all processor time in use, 0 to 1.
    """

    cpu: float


@packet_type("memory")
class Memory(msgspec.Struct, frozen=True):
    """The memory of a computer.

    Attributes:
        used_bytes: how much is in use.
        total_bytes: how much it has.
    """

    used_bytes: int
    total_bytes: int


@packet_type("temperature")
class Temperature(msgspec.Struct, frozen=True):
    """A temperature.

    Attributes:
        celsius: in degrees Celsius.
    """

    celsius: float
