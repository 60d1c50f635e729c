"""Sensors of a robot that speaks ROS 2 (`ros2.*`): each listens to a topic, or a topic for each ray."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from pancakes.devices import Infrared, Motion, Sonar
from pancakes.devices.builtin_drivers import NetworkSensor
from pancakes.devices.driver import DeviceContext
from pancakes_ros2.conversion import (
    BATTERY,
    BOOL,
    CONVERSIONS,
    RANGE,
    TEMPERATURE,
    messages_of,
    read_battery,
    read_range,
)
from pancakes_ros2.frame_tree import FrameTree
from pancakes_ros2.installation import checked_type
from pancakes_ros2.message_fields import Unusable
from pancakes_ros2.newest import Newest
from pancakes_ros2.node_table import NODES, fail
from pancakes_ros2.quality import MOVING, READING, STATIC, Quality
from pancakes_ros2.ros_node import Inlet, RosNode
from pancakes_ros2.sensor_conversion import FIX, IMAGE, IMU, JOINTS, ODOMETRY, SCAN, STATIC_TOPIC, TRANSFORMS
from pancakes_ros2.sweeps import Sweeps

MOST_HZ = 100.0
"""No body of a robot needs more readings of one sensor a second, and a topic may be flooded."""
FLOOD = 20
"""If more readings than this are left out in a second of mission time, the log says so, once."""
Hz = Annotated[float, Meta(gt=0)]


class RosSensor(NetworkSensor):
    """A sensor whose readings are the messages of a topic; a type of device is a subclass."""

    networked = False
    usual: ClassVar[str] = ""
    """The message type that it has where the settings name none."""

    @dataclass
    class Settings(NetworkSensor.Settings):
        """What it listens to.

        Attributes:
            topic: its topic; one that does not begin with a slash is below `/AGENT`.
            message: its message type.
            max_hz: how many readings a second are published, where more come; the others are left out.
            qos: how its messages are delivered.
        """

        topic: str = ""
        message: str = ""
        max_hz: Hz | None = MOST_HZ
        qos: Quality = READING

        def __post_init__(self) -> None:
            if self.message:
                self.message = checked_type(self.message)

    settings: Settings

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._node: RosNode | None = None
        self._inlets: list[Inlet] = []
        self._came: Newest[Any] = Newest(1, lambda: context.call(self._take))
        self._told: set[str] = set()
        self._heard = False
        self._left_out = 0
        self._counted_since_s = 0.0
        self._flood_told = False

    def open(self) -> None:
        self._node = NODES.take(self.context.agent, self.context.virtual)
        super().open()
        self.listen(self._node)

    def listen(self, node: RosNode) -> None:
        """Begins to listen."""
        kind = self.settings.message or self.usual

        def heard(message: Any) -> None:
            try:
                self._came.put(self.decode(kind, message))
            except Unusable as error:
                self.context.missed(f"a message of {self.settings.topic} is no reading: {error}")

        self._inlets = [self.inlet(node, kind, self.settings.topic, heard)]

    def decode(self, kind: str, message: Any) -> Any:
        """Returns the reading in a message of a type. Raises Unusable."""
        return CONVERSIONS[self.type, kind].read(message)

    def inlet(self, node: RosNode, kind: str, topic: str, heard: Any) -> Inlet:
        """Returns a subscription with the settings of this sensor."""

        def heard_something(message: Any) -> None:
            self._heard = True
            heard(message)

        return Inlet(node, kind, topic, self.settings.qos, heard_something, self._fail, self._warn)

    def close(self) -> None:
        super().close()
        for inlet in self._inlets:
            inlet.close()
        if self._node is not None:
            self._node = None
            NODES.give_back(self.context.agent)

    def silent(self) -> None:
        heard, self._heard = self._heard, False
        for inlet in self._inlets[:1]:
            if not heard:  # else what came is no reading, and the log says why
                inlet.explain(self._warn)

    def _take(self) -> None:
        if self._node is None:
            return
        bodies, lost = self._came.take()
        left_out = lost + sum(not self.take(body) for body in bodies)
        if not left_out or self._flood_told:
            return
        now_s = self.context.now()
        if now_s - self._counted_since_s > 1.0:
            self._counted_since_s, self._left_out = now_s, 0
        self._left_out += left_out
        if self._left_out > FLOOD:
            self._flood_told = True
            most = f"the {self.settings.max_hz or MOST_HZ:g} a second that are published"
            text = f"more readings come on {self.settings.topic} than {most}: those in between are left out"
            self.context.log("warning", text)

    def _fail(self, text: str) -> None:
        """Fails the device, which its service then restarts. In the node's thread."""
        self.context.call(partial(fail, text))

    def _warn(self, text: str) -> None:
        """Logs a sentence, once. In the node's thread."""
        if text not in self._told and len(self._told) < 100:
            self._told.add(text)
            self.context.log("warning", text)


def _refuse_message(settings: RosSensor.Settings, packet: str, others: tuple[str, ...] = ()) -> None:
    known = [*messages_of(packet), *others]
    if settings.message and settings.message not in known:
        raise ValueError(f"message = {settings.message!r}: no {packet} is read from that, but from {', '.join(known)}")


class RosFramed(RosSensor):
    """A pose: by odometry, by amcl, by whatever publishes it, or by tf."""

    usual = ODOMETRY

    @dataclass
    class Settings(RosSensor.Settings):
        """What it listens to.

        Attributes:
            topic: its topic, of tf `/tf` if left out; one that does not begin with a slash is below `/AGENT`.
            frame: of tf, the frame that the pose is in; `map` if left out.
            child_frame: of tf, the frame that it is the pose of; `base_link` if left out.
        """

        topic: str = "odom"
        frame: str = ""
        child_frame: str = ""

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "pose", (TRANSFORMS,))
            if self.message != TRANSFORMS:
                if self.frame or self.child_frame:
                    raise ValueError(f"frame and child_frame choose transforms of tf: set message = {TRANSFORMS!r}")
                return
            if self.topic == "odom":
                self.topic = "/tf"
            if self.qos == READING:
                self.qos = MOVING
            self.frame, self.child_frame = self.frame or "map", self.child_frame or "base_link"
            if self.frame == self.child_frame:
                raise ValueError(f"frame and child_frame are both {self.frame!r}")

    settings: Settings
    _tree: FrameTree | None = None

    def listen(self, node: RosNode) -> None:
        if self.settings.message != TRANSFORMS:
            super().listen(node)
            return
        tree = self._tree = FrameTree(self.settings.frame, self.settings.child_frame)  # only the node's thread uses it

        def heard(message: Any) -> None:
            pose, faults = tree.hear(message)
            for fault in faults:
                self._warn(f"a transform of {self.settings.topic} is left out: {fault}")
            if pose is not None:
                self._came.put(pose if self.type == "pose_3d" else pose.flat())

        static = Inlet(node, TRANSFORMS, STATIC_TOPIC, STATIC, heard, self._fail, self._warn)
        self._inlets = [self.inlet(node, TRANSFORMS, self.settings.topic, heard), static]

    def silent(self) -> None:
        if self._heard and self._tree is not None and self._node is not None:
            self._tree.explain(self._node.do, self._warn)
        super().silent()


class RosPose(RosFramed):
    """Where a robot is: by its odometry, by amcl, by tf, or by whatever publishes its pose (`ros2.pose`)."""

    type = "pose"


class RosPose3D(RosFramed):
    """Where a robot is in space, and in which frame: by its odometry, by tf, ... (`ros2.pose_3d`)."""

    type = "pose_3d"


class RosBattery(RosSensor):
    """A robot's battery (`ros2.battery`)."""

    type = "battery"
    usual = BATTERY

    @dataclass
    class Settings(RosSensor.Settings):
        """What it listens to.

        Attributes:
            full: the `percentage` of a full battery: 1 by the definition of the message; many robots say 100.
        """

        topic: str = "battery_state"
        full: Hz = 1.0

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "battery")

    settings: Settings

    def decode(self, kind: str, message: Any) -> Any:
        return read_battery(message, self.settings.full)


class RosMotion(RosSensor):
    """A motion sensor (`ros2.motion`)."""

    type = "motion"
    usual = BOOL

    @dataclass
    class Settings(RosSensor.Settings):
        """What it listens to.

        Attributes:
            invert: whether true is told as no motion, and false as motion, as for a contact that is true when closed.
        """

        topic: str = "motion"
        invert: bool = False

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "motion")

    settings: Settings

    def decode(self, kind: str, message: Any) -> Any:
        motion = super().decode(kind, message)
        return Motion(not motion.detected) if self.settings.invert else motion


class RosTemperature(RosSensor):
    """A thermometer (`ros2.temperature`)."""

    type = "temperature"
    usual = TEMPERATURE

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "temperature"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "temperature")


class RosEncoders(RosSensor):
    """The joints of a robot, such as its wheels (`ros2.encoders`)."""

    type = "encoders"
    usual = JOINTS

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "joint_states"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "encoders")


class RosImu(RosSensor):
    """An inertial measurement unit (`ros2.imu`)."""

    type = "imu"
    usual = IMU

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "imu"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "imu")


class RosGpsFix(RosSensor):
    """A receiver of GPS or another satellite system (`ros2.gps_fix`)."""

    type = "gps_fix"
    usual = FIX

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "fix"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "gps_fix")


class RosLaserScan(RosSensor):
    """A laser scanner (`ros2.laser_scan`)."""

    type = "laser_scan"
    usual = SCAN

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "scan"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "laser_scan")


class RosCamera(RosSensor):
    """A camera that publishes JPEG images (`ros2.camera`)."""

    type = "camera"
    usual = IMAGE

    @dataclass
    class Settings(RosSensor.Settings):
        topic: str = "image_raw/compressed"

        def __post_init__(self) -> None:
            super().__post_init__()
            _refuse_message(self, "camera")


class RosRing(RosSensor):
    """A ring of range sensors: a LaserScan, or a Range for each sensor on a topic of its own."""

    usual = SCAN
    body: ClassVar[type[Infrared] | type[Sonar]]

    @dataclass
    class Settings(RosSensor.Settings):
        """What it listens to.

        Attributes:
            bearings_rad: of sensors that each have a topic, `TOPIC_0` and so on, where each of them looks, in the
                frame of the body. Empty: the topic is a LaserScan.
        """

        bearings_rad: list[float] = field(default_factory=list)

        def __post_init__(self) -> None:
            super().__post_init__()
            wanted = RANGE if self.bearings_rad else SCAN
            if self.message not in ("", wanted):
                raise ValueError(
                    f"message = {self.message!r}: a topic for each of `bearings_rad` is a {RANGE}; without these"
                    f" it is a {SCAN}"
                )

    settings: Settings

    def listen(self, node: RosNode) -> None:
        bearings = tuple(self.settings.bearings_rad)
        if not bearings:
            super().listen(node)
            return
        topic = self.settings.topic
        sweeps = Sweeps(len(bearings))  # only the node's thread uses it

        def heard(number: int, message: Any) -> None:
            measured = read_range(message)
            if measured is None:
                self._warn(f"{topic}_{number} measures nothing ({message.range:g}): it is left out of the sweeps")
            sweep = sweeps.heard(number, measured)
            if sweep is None:
                return
            for silent in sweeps.silent:
                self._warn(f"{topic}_{silent} says nothing: it is left out of the sweeps")
            if not sweep:
                self.context.missed(f"none of the {len(bearings)} sensors of {topic} measures anything")
                return
            ranges = tuple(range_m for range_m, _ in sweep.values())
            most_m = max(most for _, most in sweep.values())
            self._came.put(self.body(tuple(bearings[index] for index in sweep), ranges, most_m))

        self._inlets = [
            self.inlet(node, RANGE, f"{topic}_{number}", partial(heard, number)) for number in range(len(bearings))
        ]


class RosInfrared(RosRing):
    """A ring of infrared sensors (`ros2.ir`)."""

    type = "ir"
    body = Infrared

    @dataclass
    class Settings(RosRing.Settings):
        topic: str = "ir"


class RosSonar(RosRing):
    """A ring of sonars (`ros2.sonar`)."""

    type = "sonar"
    body = Sonar

    @dataclass
    class Settings(RosRing.Settings):
        topic: str = "sonar"
