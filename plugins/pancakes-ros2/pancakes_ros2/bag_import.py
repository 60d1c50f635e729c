"""Read a rosbag2 bag as a recording, which `pancakes replay`, `report` and `record info` take. Needs `rosbags`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Final

from rosbags.highlevel import AnyReader, AnyReaderError

from pancakes.errors import PancakesError
from pancakes.packet import CTRL, SYSTEM, Packet
from pancakes.recording.mcap_writer import RecordingWriter
from pancakes.recording.records import NANOSECONDS, RecordedPacket, RecordingError
from pancakes.util.clock import SET_SINCE_S
from pancakes.util.text import fault_of_name
from pancakes_ros2.bag_messages import typestore
from pancakes_ros2.conversion import (
    BATTERY,
    BOOL,
    CONVERSIONS,
    ODOMETRY,
    POSE,
    POSE_COVARIANCE,
    SCAN,
    TEMPERATURE,
    TWIST,
    TWIST_STAMPED,
    messages_of,
)
from pancakes_ros2.frame_tree import FrameTree
from pancakes_ros2.message_fields import Unusable
from pancakes_ros2.sensor_conversion import FIX, IMAGE, IMU, JOINTS, STATIC_TOPIC, TRANSFORM, TRANSFORMS

PACKETS: Final[Mapping[str, str]] = {
    BATTERY: "battery",
    BOOL: "motion",
    FIX: "gps_fix",
    IMAGE: "camera",
    IMU: "imu",
    JOINTS: "encoders",
    ODOMETRY: "pose",
    POSE: "pose",
    POSE_COVARIANCE: "pose",
    SCAN: "laser_scan",
    TEMPERATURE: "temperature",
    TRANSFORM: "pose_3d",
    TWIST: "motors",
    TWIST_STAMPED: "motors",
}
"""The packet type of each message type, if neither the topic nor the user names another."""
TF_TOPICS: Final = ("/tf", STATIC_TOPIC)
TF_DEVICE: Final = "tf"
END_NS: Final = 1 << 63
"""Times in recordings are below it."""
REPAIR: Final = "if it was cut off, repair it: `ros2 bag reindex`, or `mcap recover` for files of MCAP"


class _TornBagError(RecordingError):
    """A bag cannot be read to its end."""


@dataclass
class Imported:
    """What became of a topic.

    Attributes:
        topic: the topic.
        message: its message type.
        agent: the agent whose packets its messages became; empty: it is left out.
        source: the publisher of the packets.
        packet: their type.
        packets: how many they are.
        left_out: how many messages are no packets.
        why: why not, of the first.
    """

    topic: str
    message: str
    agent: str = ""
    source: str = ""
    packet: str = ""
    packets: int = 0
    left_out: int = 0
    why: str = ""


@dataclass(frozen=True)
class ImportSettings:
    """How topics become devices.

    Attributes:
        agent: the agent that has all topics; empty: the first part of a topic, `/AGENT/DEVICE`, names it.
        packets: the packet types of topics that are to have another one than theirs, by topic.
        frame: with `child_frame`: the frame of poses that are made of the transforms of tf; empty: none are.
        child_frame: the frame whose poses they are.
    """

    agent: str = ""
    packets: Mapping[str, str] = field(default_factory=dict)
    frame: str = ""
    child_frame: str = ""

    def __post_init__(self) -> None:
        if self.agent and (fault := fault_of_name(self.agent)):
            raise PancakesError(f"--agent: {fault}")
        for topic, packet in self.packets.items():
            if not messages_of(packet):
                known = ", ".join(sorted({name for name, _ in CONVERSIONS if messages_of(name)}))
                raise PancakesError(f"no message is read as a packet {packet!r}, for {topic}; only as {known}")


@dataclass
class _Plan:
    row: Imported
    read: Callable[[Any], Any]
    channel: str = SYSTEM


class BagImport:
    """The import of one bag.

    Args:
        path: the bag: its folder, or its only file.
        settings: how topics become devices.

    Attributes:
        topics: what became of each topic, in the order of their names.

    Raises:
        RecordingError: it is no bag.
        PancakesError: the settings do not fit the bag.
    """

    def __init__(self, path: Path, settings: ImportSettings) -> None:
        self._path = path
        self._settings = settings
        self._tree = FrameTree(settings.frame, settings.child_frame) if settings.frame else None
        self.topics: list[Imported] = []

    def write(self, folder: Path) -> list[Path]:
        """Write the recording: a file for each agent.

        Args:
            folder: where; it is made if it is missing, and must have no recording of these agents.

        Returns:
            The files.

        Raises:
            RecordingError: the bag cannot be read, has nothing to import, or a file cannot be written.
        """
        writers: dict[str, RecordingWriter] = {}
        with ExitStack() as stack:
            for entry in self._until_torn(writers, folder):
                writer = writers.get(entry.agent)
                if writer is None:
                    writer = writers[entry.agent] = _begun(folder, entry)
                    stack.callback(_close, writer)
                with _written(writer.path):
                    writer.write(entry)
        if not writers:
            raise RecordingError(f"the bag {self._path} has no message that becomes a packet{self._first_reason()}")
        return [writer.path for writer in writers.values()]

    def _until_torn(self, begun: Mapping[str, Any], folder: Path) -> Iterator[RecordedPacket]:
        try:
            yield from self._entries()
        except _TornBagError as error:
            raise RecordingError(f"{error}{f'; the packets before are in {folder}' if begun else ''}") from None

    def _first_reason(self) -> str:
        why = next((f": {ascii(row.topic)[1:-1]}: {row.why}" for row in self.topics if row.why), "")
        return why or (": it is empty" if not self.topics else "")

    def _entries(self) -> Iterator[RecordedPacket]:
        first_ns: int | None = None
        numbers: dict[str, Iterator[int]] = {}
        for plan, time_ns, message in self._messages():
            row = plan.row
            try:
                if not 0 <= time_ns < END_NS:
                    raise Unusable(f"its time is {time_ns} ns, which no recording has")
                body = plan.read(message)
            except Unusable as error:
                row.left_out += 1
                row.why = row.why or str(error)
                continue
            except Exception as error:  # a bag defines its types, perhaps otherwise than ROS 2 does
                row.left_out += 1
                row.why = row.why or f"it is no {row.message} as ROS 2 defines it: {_reason(error)}"
                continue
            if body is None:
                continue
            first_ns = time_ns if first_ns is None else first_ns
            stamp_s = (time_ns - first_ns) / NANOSECONDS
            seq = next(numbers.setdefault(row.source, count(1)))
            row.packets += 1
            packet = Packet(plan.channel, row.packet, row.source, "", stamp_s, seq, body)
            yield RecordedPacket(time_ns, row.agent, packet)

    def _messages(self) -> Iterator[tuple[_Plan, int, Any]]:
        if not self._path.exists():
            raise RecordingError(f"there is no bag {self._path}")
        with ExitStack() as stack:
            try:
                bag = stack.enter_context(AnyReader([self._path], default_typestore=typestore()))
                found = sorted(bag.connections, key=lambda it: (it.topic, it.msgtype))
            except Exception as error:  # on torn files `rosbags`, its parsers and decompressors may raise anything
                raise RecordingError(
                    f"{self._path} cannot be read as a bag of ROS 2: {_reason(error)}; {REPAIR}"
                ) from None
            plans = {it.id: plan for it in found if (plan := self._plan(it.topic, it.msgtype)) is not None}
            self._check_names({it.topic for it in found})
            wanted = [it for it in found if it.id in plans]
            messages = bag.messages(connections=wanted) if wanted else iter(())
            while True:
                try:
                    connection, time_ns, data = next(messages)
                except StopIteration:
                    return
                except Exception as error:  # as above
                    raise _TornBagError(f"the bag {self._path} is damaged: {_reason(error)}; {REPAIR}") from None
                plan = plans[connection.id]
                try:
                    message = bag.deserialize(data, connection.msgtype)
                except Exception as error:  # torn bytes lead rosbags and numpy to raise anything
                    plan.row.left_out += 1
                    plan.row.why = plan.row.why or f"a message cannot be read: {_reason(error)}"
                    continue
                yield plan, time_ns, message

    def _check_names(self, topics: set[str]) -> None:
        for topic in self._settings.packets:
            if topic not in topics:
                raise PancakesError(f"the bag {self._path} has no topic {topic}, only {', '.join(sorted(topics))}")
        if self._tree is not None and not topics & {*TF_TOPICS}:
            raise PancakesError(f"the bag {self._path} has no topic /tf, so no pose is made of transforms")

    def _plan(self, topic: str, kind: str) -> _Plan | None:
        """Return what becomes of a topic's messages; None: they are left out."""
        row = Imported(topic, kind)
        self.topics.append(row)
        if kind == TRANSFORMS:
            return self._plan_of_transforms(row)
        names = [name for name in topic.split("/") if name]
        packet = self._settings.packets.get(topic) or _packet_of(names, kind)
        conversion = CONVERSIONS.get((packet, kind))
        if conversion is None or kind not in messages_of(packet):
            row.why = f"no packet is read from {kind}"
            if topic in self._settings.packets:
                row.why = f"a packet {packet!r} is read from {', '.join(messages_of(packet))}"
            return None
        agent = self._settings.agent
        if not agent and len(names) < 2:
            raise PancakesError(
                f"the topic {topic} does not name an agent, as /AGENT/DEVICE does: name the bag's agent with --agent"
            )
        agent = agent or names[0]
        device = "_".join(names[1:] if names[0] == agent and len(names) > 1 else names)
        if fault := fault_of_name(agent):
            raise PancakesError(f"the agent of a topic: {fault}; name it with --agent")
        if fault := fault_of_name(device):
            row.why = f"its device: {fault}"
            return None
        row.agent, row.packet = agent, packet
        row.source = f"{agent}/client/{device}" if packet == "motors" else f"{agent}/device/{device}"
        other = next((it.topic for it in self.topics[:-1] if it.source == row.source and it.topic != topic), "")
        if other:
            row.agent, row.source, row.packet = "", "", ""
            row.why = f"its device would have the name of that of {other}"
            return None
        return _Plan(row, conversion.read, CTRL if packet == "motors" else SYSTEM)

    def _plan_of_transforms(self, row: Imported) -> _Plan | None:
        if self._tree is None:
            row.why = "of transforms only --tf FRAME:CHILD makes poses"
            return None
        child = self._settings.child_frame
        agent = self._settings.agent or child.partition("/")[0]
        if fault := fault_of_name(agent):
            raise PancakesError(f"the agent of the child frame: {fault}; name it with --agent")
        row.agent, row.source, row.packet = agent, f"{agent}/device/{TF_DEVICE}", "pose_3d"
        return _Plan(row, partial(self._read_transforms, row))

    def _read_transforms(self, row: Imported, message: Any) -> Any:
        assert self._tree is not None
        pose, faults = self._tree.hear(message)
        if faults:
            row.left_out += 1
            row.why = row.why or faults[0]
        return pose


def _packet_of(names: list[str], kind: str) -> str:
    """Return the packet type of a topic: the last part of its name if that is one, else that of its message type."""
    last = names[-1] if names else ""
    return last if kind in messages_of(last) else PACKETS.get(kind, "")


@contextmanager
def _written(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path} cannot be written: {error.strerror or error}") from None


def _close(writer: RecordingWriter) -> None:
    with _written(writer.path):
        writer.close()


def _begun(folder: Path, entry: RecordedPacket) -> RecordingWriter:
    path = folder / f"{entry.agent}.mcap"
    clock = "time of day" if entry.time_ns >= SET_SINCE_S * NANOSECONDS else "mission time"
    with _written(path):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            return RecordingWriter(path, {"agent": entry.agent, "clock": clock, "speed": "1.0", "task": ""})
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another --out") from None


def _reason(error: BaseException) -> str:
    text = (str(error).split("\n")[0] or type(error).__name__).rstrip(".")
    return text if isinstance(error, (AnyReaderError, OSError)) else f"{type(error).__name__}: {text}"
