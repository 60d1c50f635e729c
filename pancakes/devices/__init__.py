"""Devices: the packet types of readings and commands (`Pose`, `Twist`, `Battery`, ...). Drivers are in `driver.py`.

A device's type, the type of its packets and the word in a task's `requires` are the same name: a `pose` device
publishes `pose` packets on `system`; a `motors` device takes `motors` packets from `ctrl`. Lengths are metres, angles
are radians counter-clockwise, times are seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import msgspec

from pancakes.devices.validation import MaybeNan
from pancakes.packet import packet_type

if TYPE_CHECKING:
    import numpy
    from numpy.typing import NDArray


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


@packet_type("robot_pose")
class RobotPose(msgspec.Struct, frozen=True):
    """Where a robot is, for the filters of other robots (docs/filters.md); on `system`, to all neighbours.

    A barrier filter publishes that of its own robot. A tracker, such as a motion capture, publishes those of bodies
    that are no agents, or whose agents are silent.

    Attributes:
        robot: its name; that of its agent if it has one.
        x_m: position of its centre along the world's x axis.
        y_m: position of its centre along the world's y axis.
        theta_rad: heading, counter-clockwise from the x axis.
        radius_m: the radius of a circle around its centre that holds all of it.
        max_mps: how fast it may move.
        age_s: how old the pose was when it was published, in mission seconds.
        ahead_m: how far ahead of its centre the point lies that its own barrier keeps clear.
        yields: whether a barrier filter of its own moves it out of the way; only its own agent is believed.
    """

    robot: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    x_m: float
    y_m: float
    theta_rad: float
    radius_m: Annotated[float, msgspec.Meta(ge=0)]
    max_mps: Annotated[float, msgspec.Meta(ge=0)]
    age_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    ahead_m: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    yields: bool = False


@packet_type("battery")
class Battery(msgspec.Struct, frozen=True, omit_defaults=True):
    """The state of a battery.

    Attributes:
        voltage_v: voltage at the terminals; NaN: it is not known.
        level: what is left of its range, from 0 (empty) to 1 (full).
        charging: whether current flows into it; False if the driver cannot tell.
    """

    voltage_v: MaybeNan
    level: Annotated[float, msgspec.Meta(ge=0, le=1)]
    charging: bool = False


@packet_type("dock")
class Dock(msgspec.Struct, frozen=True):
    """A command to a dock: hold it for this robot, and charge the robot once it is there (docs/energy.md).

    A robot repeats it for as long as it needs the dock. Its first command takes a dock that is free.

    Attributes:
        at: the address of the dock's device, such as `dock1/device/dock`.
    """

    at: Annotated[str, msgspec.Meta(min_length=1, max_length=256)]


@packet_type("dock_state")
class DockState(msgspec.Struct, frozen=True):
    """What a dock does; on `system`, to its own agent and to all neighbours. Its source is the dock's device.

    Attributes:
        state: `free`, `taken` (a robot holds it), or `charging` (that robot is there, and current flows).
        x_m: where a robot stands to be charged, along the world's x axis.
        y_m: the same along y.
        robot: the agent of the robot that holds it; empty if it is free.
    """

    state: Literal["free", "taken", "charging"]
    x_m: float
    y_m: float
    robot: Annotated[str, msgspec.Meta(max_length=64)] = ""


@packet_type("dock_bid")
class DockBid(msgspec.Struct, frozen=True):
    """A robot asks for a dock; on `system`, to all neighbours. The lowest `seconds` comes first, ties by name.

    Attributes:
        seconds: the robot's reserve.
        x_m: where the robot is, along the world's x axis.
        y_m: the same along y.
        avoids: addresses of docks that it does not want, because they failed to charge it.
    """

    seconds: float
    x_m: float
    y_m: float
    avoids: Annotated[tuple[str, ...], msgspec.Meta(max_length=256)] = ()


@packet_type("reserve")
class Reserve(msgspec.Struct, frozen=True):
    """What a robot has beyond the way to a dock: a reading of the task `energy.reserve`, on `system`.

    Attributes:
        seconds: how long the robot can go on as it does now, and then still reach the nearest dock and have its margin
            left; at most a day, 0 or less if it must go now. 0 too if it knows no dock.
        level: the same as a share of the battery.
        dock: the address of the nearest dock; empty if it knows none.
        way_m: how far that is, with the allowance for detours.
        level_per_s: what the battery loses each second, as measured.
        level_per_m: what it loses for each metre that the robot drives, as measured.
        charging: whether its battery says that it is being charged.
        bad_docks: addresses of docks that said they charge this robot, while its battery did not rise.
        trouble: what is wrong with docks or battery, as a sentence; empty: nothing.
    """

    seconds: float
    level: float
    dock: str = ""
    way_m: float = 0.0
    level_per_s: float = 0.0
    level_per_m: float = 0.0
    charging: bool = False
    bad_docks: tuple[str, ...] = ()
    trouble: str = ""

    def seconds_after(self, way_m: float) -> float:
        """Return the seconds that are left if the robot drives farther than the way to the dock.

        For cost functions that know where a task is: from here to the task and from there to the dock, less `way_m`.
        """
        if self.level_per_s <= 0.0:
            return self.seconds
        return self.seconds - way_m * self.level_per_m / self.level_per_s


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


MOST_FRAME: Final = 256
"""The longest name of a frame, in characters."""
FrameName: TypeAlias = Annotated[str, msgspec.Meta(max_length=MOST_FRAME)]
"""The name of a frame of reference, such as `map`."""
Vector: TypeAlias = tuple[float, float, float]
"""Parts along x (ahead), y (to the left) and z (up)."""
Quaternion: TypeAlias = tuple[float, float, float, float]
"""An orientation as a unit quaternion, in the order x, y, z, w."""
LEVEL: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)
"""No turn."""
_UNIT: Final = 0.01
"""The length of a quaternion may differ from 1 by this much: drivers round."""
_NANOMETRES: Final = 1e-9
_MOST_WHEEL: Final = 64
"""The longest name of a wheel or joint."""


def _check_unit(quaternion: Quaternion) -> None:
    if not all(map(math.isfinite, quaternion)):
        return  # it is found as in any reading
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > _UNIT:
        raise ValueError(f"orientation has the length {length:.3g}, and a quaternion of an orientation has 1")


def _check_length(what: str, text: str, most: int) -> None:
    if len(text) > most:  # msgspec checks only what comes from elsewhere
        raise ValueError(f"{what} {text[:20]!r}... has {len(text)} characters, and has at most {most}")


@packet_type("encoders")
class Encoders(msgspec.Struct, frozen=True):
    """How far the wheels or joints of a body have turned.

    Attributes:
        wheels: the name of each, such as `left` and `right`.
        angles_rad: how far each has turned since the device began; forward is positive. It grows over full turns.
        speeds_radps: how fast each turns; empty if the encoder does not measure that.
    """

    wheels: tuple[Annotated[str, msgspec.Meta(min_length=1, max_length=64)], ...]
    angles_rad: tuple[float, ...]
    speeds_radps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.wheels)
        if len(set(self.wheels)) < count:
            raise ValueError(f"wheels has a name twice: {', '.join(self.wheels)}")
        for name in self.wheels:
            if not name:
                raise ValueError("wheels has an empty name")
            _check_length("the wheel", name, _MOST_WHEEL)
        for name, values in (("angles_rad", self.angles_rad), ("speeds_radps", self.speeds_radps)):
            if len(values) != count and (values or name == "angles_rad"):
                raise ValueError(f"{name} has {len(values)} numbers for {count} wheels")


@packet_type("imu")
class Imu(msgspec.Struct, frozen=True):
    """What an inertial measurement unit says, in its own frame: x ahead, y to the left, z up.

    Attributes:
        angular_radps: turning rate about each axis.
        acceleration_mps2: acceleration along each axis, gravity included: a unit at rest says (0, 0, 9.81).
        orientation: its orientation in a frame whose z axis is up; None if the unit does not tell it.
        frame: the frame of the unit; empty: that of the body.
    """

    angular_radps: Vector
    acceleration_mps2: Vector
    orientation: Quaternion | None = None
    frame: FrameName = ""

    def __post_init__(self) -> None:
        if self.orientation is not None:
            _check_unit(self.orientation)
        _check_length("the frame", self.frame, MOST_FRAME)


@packet_type("gps_fix")
class GpsFix(msgspec.Struct, frozen=True):
    """A position on the earth, of a receiver of GPS or another satellite system (WGS 84). Without a fix, none is sent.

    Attributes:
        latitude_deg: north of the equator is positive.
        longitude_deg: east of Greenwich is positive.
        altitude_m: height above the ellipsoid; None if it is not known.
        horizontal_m: standard deviation of the position along each horizontal axis; None if it is not known.
        vertical_m: standard deviation of the altitude; None if it is not known.
        frame: the frame of the antenna; empty: that of the body.
    """

    latitude_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    longitude_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    altitude_m: float | None = None
    horizontal_m: Annotated[float, msgspec.Meta(ge=0)] | None = None
    vertical_m: Annotated[float, msgspec.Meta(ge=0)] | None = None
    frame: FrameName = ""

    def __post_init__(self) -> None:
        _check_length("the frame", self.frame, MOST_FRAME)


MOST_RAYS: Final = 8192
_MOST_RANGE_M: Final = 1e6
"""No scanner sees farther, and millimetres beyond do not fit the numbers of other programs."""


def _check_range(max_range_m: float) -> None:
    if not 0.0 < max_range_m <= _MOST_RANGE_M:
        raise ValueError(f"max_range_m is {max_range_m:g}: it must be finite, above 0, and at most {_MOST_RANGE_M:g}")


@packet_type("laser_scan")
class LaserScan(msgspec.Struct, frozen=True):
    """One sweep of a laser scanner, whose rays are at equal steps. Three bytes a ray on the wire, five beyond 65 m.

    `LaserScan.of` makes one from metres. `ranges_m` and `bearings_rad` return numpy arrays.

    Attributes:
        start_rad: direction of the first ray, in the frame of the scanner; counter-clockwise from straight ahead.
        step_rad: from each ray to the next; negative for a scanner that turns clockwise.
        ranges_mm: the distance along each ray in whole millimetres; the full range if nothing is seen, 0 if the ray
            measured nothing.
        max_range_m: the full range.
        frame: the frame of the scanner; empty: that of the body.
    """

    start_rad: float
    step_rad: float
    ranges_mm: Annotated[tuple[int, ...], msgspec.Meta(max_length=MOST_RAYS)]
    max_range_m: Annotated[float, msgspec.Meta(gt=0)]
    frame: FrameName = ""

    def __post_init__(self) -> None:
        _check_range(self.max_range_m)
        _check_length("the frame", self.frame, MOST_FRAME)
        if not self.ranges_mm:
            raise ValueError("ranges_mm is empty: a scan has at least one ray")
        if len(self.ranges_mm) > MOST_RAYS:
            raise ValueError(f"ranges_mm has {len(self.ranges_mm)} rays, and a scan has at most {MOST_RAYS}")
        nearest, farthest = min(self.ranges_mm), max(self.ranges_mm)
        if nearest < 0:
            raise ValueError(f"ranges_mm has {nearest}, below 0")
        if farthest > math.ceil(self.max_range_m * 1000 - _NANOMETRES):
            raise ValueError(f"ranges_mm has {farthest}, beyond max_range_m = {self.max_range_m:g}")

    @classmethod
    def of(
        cls, start_rad: float, step_rad: float, ranges_m: Iterable[float], max_range_m: float, frame: str = ""
    ) -> LaserScan:
        """Make a scan from distances in metres.

        Args:
            start_rad: direction of the first ray.
            step_rad: from each ray to the next.
            ranges_m: the distance along each ray, as a sequence or a numpy array. Infinity, and what is beyond the full
                range, is nothing seen; NaN is no measurement; minus infinity, and zero, is too near to tell.
            max_range_m: the full range.
            frame: the frame of the scanner; empty: that of the body.

        Raises:
            ValueError: there is no ray, or a number that is no distance.
        """
        _check_range(max_range_m)
        if not (math.isfinite(start_rad) and math.isfinite(step_rad)):
            raise ValueError(f"start_rad = {start_rad:g} and step_rad = {step_rad:g} must be finite")
        most_mm = math.ceil(max_range_m * 1000 - _NANOMETRES)
        found = []
        for range_m in ranges_m:
            if range_m != range_m:
                found.append(0)
            elif range_m >= max_range_m:
                found.append(most_mm)
            elif range_m >= 0.0 or range_m == -math.inf:
                found.append(max(1, round(1000 * range_m)) if range_m > 0.0 else 1)
            else:
                raise ValueError(f"a range of {range_m:g} m is below 0")
        return cls(start_rad, step_rad, tuple(found), max_range_m, frame)

    def ranges_m(self) -> NDArray[numpy.float64]:
        """Return the distances in metres: the full range if nothing is seen, NaN if the ray measured nothing."""
        import numpy

        ranges_m = numpy.minimum(numpy.array(self.ranges_mm, dtype=float) / 1000.0, self.max_range_m)
        ranges_m[ranges_m == 0.0] = math.nan
        return ranges_m

    def bearings_rad(self) -> NDArray[numpy.float64]:
        """Return the direction of each ray, in the frame of the scanner."""
        import numpy

        rays = numpy.arange(len(self.ranges_mm), dtype=numpy.float64)
        return self.start_rad + self.step_rad * rays


MOST_JPEG_BYTES: Final = 1 << 20


@packet_type("camera")
class CameraFrame(msgspec.Struct, frozen=True):
    """One image of a camera, compressed as JPEG. A task takes the newest: `@on(SYSTEM, CameraFrame, queue="latest")`.

    Attributes:
        jpeg: the image, at most 1 MiB: choose a smaller size or quality for a larger one. To another agent at most
            250 kB travel, as of any packet.
        frame: the optical frame of the camera; empty: that of the body.
    """

    jpeg: Annotated[bytes, msgspec.Meta(max_length=MOST_JPEG_BYTES)]
    frame: FrameName = ""

    def __post_init__(self) -> None:
        if len(self.jpeg) > MOST_JPEG_BYTES:
            raise ValueError(f"jpeg has {len(self.jpeg)} bytes, and an image has at most {MOST_JPEG_BYTES}")
        _check_length("the frame", self.frame, MOST_FRAME)
        self.size_px()

    def size_px(self) -> tuple[int, int]:
        """Return the width and height of the image, from its header."""
        from pancakes.util.jpeg import jpeg_size

        return jpeg_size(self.jpeg)


@packet_type("pose_3d")
class Pose3D(msgspec.Struct, frozen=True):
    """Where a body is, in three dimensions and in a frame of reference that it names.

    Attributes:
        frame: the frame that the numbers are in, such as `map` or `odom`.
        x_m: position along that frame's x axis.
        y_m: position along that frame's y axis.
        z_m: position along that frame's z axis.
        orientation: the orientation of the body in that frame.
    """

    frame: Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
    x_m: float
    y_m: float
    z_m: float
    orientation: Quaternion = LEVEL

    def __post_init__(self) -> None:
        if not self.frame:
            raise ValueError("frame is empty: a pose in space names the frame that it is in")
        _check_length("the frame", self.frame, MOST_FRAME)
        _check_unit(self.orientation)

    def flat(self) -> Pose:
        """Return the position and heading in the plane of the frame: its height, roll and pitch are left out."""
        x, y, z, w = self.orientation
        heading_rad = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return Pose(self.x_m, self.y_m, math.pi if heading_rad == -math.pi else heading_rad)
