"""A row of the table of topics: which packets are which messages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from pancakes.errors import PancakesError
from pancakes.packet import body_class, body_from_plain, body_to_plain, known_types
from pancakes.util.text import suggestion
from pancakes_ros2.conversion import CONVERSIONS
from pancakes_ros2.installation import checked_type, message_class
from pancakes_ros2.message_fields import Conversion, Moment, Unusable, not_read
from pancakes_ros2.quality import Quality
from pancakes_ros2.ros_message import RosMessage, fill, plain_of, put_at, value_at
from pancakes_ros2.sensor_conversion import TRANSFORM, TRANSFORMS

ANY: Final = "ros2.message"
Hz = Annotated[float, Meta(gt=0)]


@dataclass(frozen=True)
class TopicRow:
    """One topic.

    Attributes:
        topic: its name; one that does not begin with a slash is below `/AGENT`.
        message: its message type, such as `geometry_msgs/msg/PoseStamped`; any that is installed.
        packet: the packet type; `ros2.message` is a message of any type, as it is.
        direction: `out`: packets become messages; `in`: messages become packets.
        channel: the channel of the packets.
        fields: which field of the message is which of the packet, by dotted names; for types that are no devices of
            Pancakes. Without it, fields of one name are one field.
        frame: the frame of reference that a message with a header names; empty: the agent's name, of a transform `map`.
            Of transforms with the direction `in`: the frame that the poses are in.
        child_frame: of transforms, the frame of the body; empty: the agent's name.
        max_hz: how many a second pass, at most; the others are left out.
        include_remote: of `out`: whether packets of other agents count that come to that channel.
        qos: how the messages are delivered.
    """

    topic: str
    message: str
    packet: str = ANY
    direction: Literal["out", "in"] = "out"
    channel: str = "system"
    fields: dict[str, str] = field(default_factory=dict)
    frame: str = ""
    child_frame: str = ""
    max_hz: Hz = 100.0
    include_remote: bool = False
    qos: Quality = Quality()

    def __post_init__(self) -> None:
        object.__setattr__(self, "message", checked_type(self.message))
        if self.fields and self.packet == ANY:
            raise ValueError(f"fields: a packet of the type {ANY!r} has those of the message; name another type")
        if self.child_frame and self.message not in (TRANSFORM, TRANSFORMS):
            raise ValueError(f"child_frame: only {TRANSFORM} and {TRANSFORMS} name one, not {self.message}")
        if self.frame and self.frame == self.child_frame:
            raise ValueError(f"frame and child_frame are both {self.frame!r}")
        if self.direction == "out" and self.topic == "/tf_static" and self.qos.durability != "transient_local":
            raise ValueError(
                "topic = '/tf_static': its readers come later, so it needs"
                ' qos = { durability = "transient_local", depth = 1 }'
            )
        if self.direction == "in" and self.conversion is not None and self.conversion.read is not_read:
            if self.composes:
                return
            raise ValueError(
                f"direction = 'in': {self.packet} is not read from {self.message} here; a device with the driver"
                f" ros2.{self.packet} does so, from a topic for each sensor"
            )

    @property
    def conversion(self) -> Conversion | None:
        """How the devices of Pancakes are read and written; None: field by field."""
        return None if self.fields else CONVERSIONS.get((self.packet, self.message))

    @property
    def composes(self) -> bool:
        """Whether its messages are transforms of tf, of which several together are a pose."""
        return self.message == TRANSFORMS and self.packet in ("pose", "pose_3d") and not self.fields

    def frames(self, agent: str) -> tuple[str, str]:
        """Return the frame of its messages, and that of the body.

        Args:
            agent: the agent's name.
        """
        is_transform = self.message in (TRANSFORM, TRANSFORMS)
        return self.frame or ("map" if is_transform else agent), self.child_frame or agent

    def check_packet(self) -> None:
        """Makes sure that there is its packet type.

        Raises:
            PancakesError: no distribution registers it.
        """
        if body_class(self.packet) is None:
            near = suggestion(self.packet, list(known_types()))
            hint = f", did you mean {near!r}?" if near else ""
            raise PancakesError(f"topic {self.topic!r}: there is no packet type {self.packet!r}{hint}")

    def read(self, message: Any) -> Any:
        """Returns the body of a packet.

        Raises:
            Unusable, RemoteProtocolError: the message has what no such packet can say.
        """
        conversion = self.conversion
        if conversion is not None:
            return conversion.read(message)
        plain = plain_of(message)
        if self.packet == ANY:
            return RosMessage(self.message, plain)
        if self.fields:
            plain = _renamed(plain, self.fields.items())
        _check_finite(plain, "")
        return body_from_plain(self.packet, plain)

    def parts(self, body: Any) -> int | None:
        """Returns how many topics a body goes to, `TOPIC_0` and so on; None: one, the topic itself."""
        conversion = self.conversion
        return conversion.parts(body) if conversion is not None and conversion.parts is not None else None

    def write(self, message: Any, body: Any, moment: Moment, part: int) -> None:
        """Fills an empty message.

        Raises:
            Unusable: the packet has what no such message can say.
        """
        conversion = self.conversion
        if conversion is not None:
            if conversion.item is not None:
                items, kind = conversion.item
                setattr(message, items, [message_class(kind)()])
            conversion.write(message, body, moment, part)
            return
        if isinstance(body, RosMessage):
            if checked_type(body.type) != self.message:
                raise Unusable(f"the packet is a {body.type}, the topic has {self.message}")
            fill(message, body.fields)
            return
        plain = body_to_plain(body)
        if self.fields:
            plain = _renamed(plain, ((theirs, ours) for ours, theirs in self.fields.items()))
        _check_finite(plain, "")
        if hasattr(message, "header") and "header" not in plain:
            message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = moment[:3]
        fill(message, plain)


def _renamed(plain: Mapping[str, Any], names: Iterable[tuple[str, str]]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for source, target in names:
        put_at(made, target, value_at(plain, source))
    return made


def _check_finite(plain: Any, path: str) -> None:
    """Refuses NaN and infinity, of which no packet type says what they mean; a packet `ros2.message` may have them."""
    if isinstance(plain, Mapping):
        for key, value in plain.items():
            _check_finite(value, f"{path}.{key}" if path else key)
    elif isinstance(plain, (list, tuple)):
        for number, value in enumerate(plain):
            _check_finite(value, f"{path}[{number}]")
    elif isinstance(plain, float) and not math.isfinite(plain):
        raise Unusable(f"{path} is not finite ({plain:g})")
