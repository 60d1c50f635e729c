"""What conversions between packets and messages have in common. Pure: messages are what has their fields."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from pancakes.devices import MOST_FRAME, Quaternion, Vector
from pancakes.errors import PancakesError

_T = TypeVar("_T")


class Unusable(PancakesError):
    """A message or packet says what the other side cannot be told."""


class Moment(NamedTuple):
    """When a message was made, by the node's clock, the frame of reference that it is in, and that of the body."""

    sec: int
    nanosec: int
    frame: str
    child: str = ""


def not_read(message: Any) -> Any:
    """Stands for a message that no packet is read from.

    Raises:
        Unusable: always.
    """
    raise Unusable("no packet is read from such a message")


@dataclass(frozen=True)
class Conversion:
    """How packets of a type and messages of a type become each other.

    Attributes:
        read: makes the body of a packet of a message; raises `Unusable`. `not_read`: there is no way.
        write: fills a message from the body of a packet; its last argument is the number of the part.
        parts: how many messages one body becomes, each on a topic of its own; None: one, on the topic itself.
        item: the list in the message that has what is written, and the message type of its items: the message gets one
            empty item before it is written.
    """

    read: Callable[[Any], Any]
    write: Callable[[Any, Any, Moment, int], None]
    parts: Callable[[Any], int] | None = None
    item: tuple[str, str] | None = None


def yaw(orientation: Any) -> float:
    """Return the heading of a quaternion, in (-pi, pi]."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return math.pi if heading == -math.pi else heading


def stamp(header: Any, moment: Moment) -> None:
    """Fill a std_msgs/Header."""
    header.stamp.sec, header.stamp.nanosec, header.frame_id = moment[:3]


def finite(what: str, *values: float) -> None:
    """Refuse what is no number.

    Raises:
        Unusable: one of the values is NaN or infinite.
    """
    if not all(map(math.isfinite, values)):
        raise Unusable(f"{what} is not finite ({', '.join(f'{value:g}' for value in values)})")


def made(cls: Callable[..., _T], *values: Any) -> _T:
    """Make the body of a packet.

    Raises:
        Unusable: its values do not agree.
    """
    try:
        return cls(*values)
    except ValueError as error:
        raise Unusable(str(error)) from None


def frame_of(header: Any) -> str:
    """Return the frame that a std_msgs/Header names.

    Raises:
        Unusable: its name is too long.
    """
    return frame_name(header.frame_id)


def frame_name(told: Any) -> str:
    """Return the name of a frame.

    Raises:
        Unusable: it is too long.
    """
    frame = str(told)
    if len(frame) > MOST_FRAME:
        raise Unusable(f"the name of its frame has {len(frame)} characters, and at most {MOST_FRAME} are taken")
    return frame


def vector_of(what: str, vector: Any) -> Vector:
    """Read a geometry_msgs/Vector3 or Point.

    Raises:
        Unusable: a number is not finite.
    """
    finite(what, vector.x, vector.y, vector.z)
    return float(vector.x), float(vector.y), float(vector.z)


def fill_vector(vector: Any, values: Sequence[float]) -> None:
    """Fill a geometry_msgs/Vector3 or Point."""
    vector.x, vector.y, vector.z = map(float, values)


def orientation_of(what: str, orientation: Any) -> Quaternion:
    """Read a geometry_msgs/Quaternion, scaled to the length 1.

    Raises:
        Unusable: a number is not finite, or its length is far from 1.
    """
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    finite(what, x, y, z, w)
    length = math.hypot(x, y, z, w)
    if length == 0.0:
        raise Unusable(f"{what} has no orientation: its quaternion is zero")
    if abs(length - 1.0) > 0.1:
        raise Unusable(f"{what} has a quaternion of the length {length:.3g}, and that of an orientation is 1")
    return float(x / length), float(y / length), float(z / length), float(w / length)


def fill_orientation(orientation: Any, values: Sequence[float]) -> None:
    """Fill a geometry_msgs/Quaternion."""
    orientation.x, orientation.y, orientation.z, orientation.w = map(float, values)
