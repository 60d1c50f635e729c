"""Write a recording as a rosbag2 bag with standard messages, which `ros2 bag play` takes. Needs `rosbags`.

What an agent has published itself becomes messages on `/AGENT/DEVICE`; what it heard of others is in their recordings.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine, level_of
from pancakes.packet import CTRL, LOG, SYSTEM, agent_of
from pancakes.recording.records import NANOSECONDS, RecordedPacket, RecordingError
from pancakes_ros2.bag_messages import empty, to_bytes, typestore
from pancakes_ros2.conversion import BATTERY, BOOL, CONVERSIONS, POSE, RANGE, SCAN, TEMPERATURE, TWIST
from pancakes_ros2.installation import ros_name
from pancakes_ros2.log_messages import LOG_LEVELS, LOG_MESSAGE, log_text
from pancakes_ros2.message_fields import Moment, Unusable
from pancakes_ros2.sensor_conversion import FIX, IMAGE, IMU, JOINTS, TRANSFORMS

STORAGES: Final = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
VERSION: Final = 8
"""The version of the bag's metadata, that of Iron: later releases read it too."""
MESSAGES: Final[Mapping[str, tuple[str, ...]]] = {
    "battery": (BATTERY,),
    "camera": (IMAGE,),
    "encoders": (JOINTS,),
    "gps_fix": (FIX,),
    "imu": (IMU,),
    "ir": (SCAN, RANGE),
    "laser_scan": (SCAN,),
    "motion": (BOOL,),
    "motors": (TWIST,),
    "pose": (POSE,),
    "pose_3d": (POSE,),
    "sonar": (SCAN, RANGE),
    "temperature": (TEMPERATURE,),
}
"""The message type of each packet type; of several, the first that can say it."""
COMMANDS: Final = "cmd_vel"
END_S: Final = 2**31
"""Seconds of builtin_interfaces/Time are below it."""
WORLD: Final = "map"
"""The frame of a pose in the plane, which does not name one."""


@dataclass
class Exported:
    """One topic of the bag, or a packet type that is left out.

    Attributes:
        topic: the topic; of what is left out, the topic in the recording, `/AGENT/CHANNEL/TYPE`, or `/AGENT` if none of
            its packets could be exported.
        message: the message type; empty: it is left out.
        messages: how many messages.
        left_out: how many packets were left out.
        why: why packets of it were left out; of several reasons the first.
    """

    topic: str
    message: str = ""
    messages: int = 0
    left_out: int = 0
    why: str = ""


@dataclass
class _Message:
    topic: str
    kind: str
    data: bytes


@dataclass
class BagExport:
    """The export of one recording.

    Attributes:
        topics: what became of each topic.
    """

    topics: dict[str, Exported] = field(default_factory=dict)
    _kinds: dict[str, str] = field(default_factory=dict)
    _agents: dict[str, str] = field(default_factory=dict)
    _sources: dict[str, str] = field(default_factory=dict)
    _own: set[str] = field(default_factory=set)
    _heard: Counter[str] = field(default_factory=Counter)

    def write(self, entries: Iterable[RecordedPacket], path: Path, storage: str) -> None:
        """Write a bag; if that fails, nothing is left of it.

        Args:
            entries: the recording, in the order of time.
            path: the folder of the bag, which must not exist.
            storage: `sqlite3` or `mcap`.

        Raises:
            RecordingError: it cannot be written, or the recording cannot be read.
        """
        self._store = typestore()
        is_new, is_open = not os.path.lexists(path), False
        try:
            with Writer(path, version=VERSION, storage_plugin=STORAGES[storage]) as writer:
                is_open = True
                connections: dict[str, Any] = {}
                for entry in entries:
                    for one in self._messages(entry):
                        topic = self._topic(one)
                        if topic not in connections:
                            connections[topic] = writer.add_connection(topic, one.kind, typestore=self._store)
                        writer.write(connections[topic], entry.time_ns, one.data)
        except BaseException as error:
            # Before it is open, a `WriterError` says that another program has made the folder meanwhile.
            if is_new and (is_open or not isinstance(error, WriterError)):
                shutil.rmtree(path, ignore_errors=True)
            if isinstance(error, PancakesError) or not isinstance(error, Exception):
                raise
            # On a full disk `rosbags` raises its own, and SQLite's.
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise RecordingError(f"the bag {path} cannot be written: {reason}") from None

    def rows(self) -> list[Exported]:
        """Return the topics of the bag, and then what was left out."""
        heard = [
            Exported(f"/{agent}", left_out=packets, why="others heard it, and its own recording is not here")
            for agent, packets in self._heard.items()
            if agent not in self._own
        ]
        return sorted([*self.topics.values(), *heard], key=lambda row: (not row.message, row.topic))

    def _messages(self, entry: RecordedPacket) -> Iterator[_Message]:
        packet = entry.packet
        publisher = agent_of(packet.source)
        if publisher != entry.agent:
            self._heard[publisher] += 1
            return  # its own agent has it
        self._own.add(publisher)
        if not 0 <= entry.time_ns < END_S * NANOSECONDS:
            self._leave_out(entry.topic, "its time is not between 1970 and 2038, as those of ROS 2 are")
            return
        if packet.channel == LOG and isinstance(packet.body, (LogLine, Event)):
            try:
                yield self._log(entry, packet.body)
            except Unusable as error:
                self._leave_out("/rosout", str(error))
            return
        kinds = MESSAGES.get(packet.type, ()) if packet.channel in (SYSTEM, CTRL) else ()
        if not kinds or isinstance(packet.body, Mapping):
            unknown = "no message says it" if not kinds else "its packet type is unknown here"
            self._leave_out(entry.topic, unknown)
            return
        name = COMMANDS if packet.type == "motors" else packet.source.rpartition("/")[2]
        topic = f"/{self._namespace(entry.agent)}/{ros_name(name)}"
        if packet.type != "motors" and (other := self._sources.setdefault(topic, packet.source)) != packet.source:
            self._leave_out(entry.topic, f"{packet.source} and {other} would both be {topic} in ROS 2")
            return
        why = ""
        for kind in kinds:
            try:
                made = list(self._made(entry, topic, kind))
                if not made:
                    continue
            except Unusable as error:
                why = why or str(error)
                continue
            yield from made
            return
        self._leave_out(topic, why)

    def _made(self, entry: RecordedPacket, topic: str, kind: str) -> Iterator[_Message]:
        packet = entry.packet
        conversion = CONVERSIONS[packet.type, kind]
        seconds, nanoseconds = divmod(entry.time_ns, NANOSECONDS)
        moment = Moment(seconds, nanoseconds, WORLD if packet.type == "pose" else entry.agent, entry.agent)
        if conversion.parts is not None:
            for part in range(conversion.parts(packet.body)):
                message = empty(self._store, kind)
                conversion.write(
                    message, packet.body, moment._replace(frame=f"{entry.agent}/{packet.type}_{part}"), part
                )
                yield self._message(f"{topic}_{part}", kind, message)
            return
        message = empty(self._store, kind)
        conversion.write(message, packet.body, moment, 0)
        yield self._message(topic, kind, message)
        if packet.type == "pose":
            tf, frames = CONVERSIONS["pose", TRANSFORMS], empty(self._store, TRANSFORMS)
            assert tf.item is not None
            frames.transforms = [empty(self._store, tf.item[1])]
            tf.write(frames, packet.body, moment, 0)
            yield self._message("/tf", TRANSFORMS, frames)

    def _log(self, entry: RecordedPacket, body: LogLine | Event) -> _Message:
        message = empty(self._store, LOG_MESSAGE)
        message.stamp.sec, message.stamp.nanosec = divmod(entry.time_ns, NANOSECONDS)
        message.level, message.name, message.msg = LOG_LEVELS[level_of(body)], entry.packet.source, log_text(body)
        return self._message("/rosout", LOG_MESSAGE, message)

    def _message(self, topic: str, kind: str, message: Any) -> _Message:
        return _Message(topic, kind, to_bytes(self._store, kind, message))

    def _topic(self, one: _Message) -> str:
        """Return the topic of a message, and count it there; a topic has one message type."""
        topic, kind = one.topic, one.kind
        if self._kinds.setdefault(topic, kind) != kind:
            topic = f"{topic}_{ros_name(kind.rpartition('/')[2]).lower()}"
            self._kinds[topic] = kind
        row = self.topics.setdefault(topic, Exported(topic, kind))
        row.message = kind
        row.messages += 1
        return topic

    def _leave_out(self, topic: str, why: str) -> None:
        row = self.topics.setdefault(topic, Exported(topic))
        row.left_out += 1
        row.why = row.why or why

    def _namespace(self, agent: str) -> str:
        name = ros_name(agent)
        other = self._agents.setdefault(name, agent)
        if other != agent:
            raise RecordingError(f"the agents {other} and {agent} would both be /{name} in ROS 2: export one at a time")
        return name
