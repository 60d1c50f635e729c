"""What a simulated robot's devices and the simulated world say to each other: the hardware bus.

It stands for the wires inside a robot, so it has connections of its own, takes part in no fault of the mesh and
costs no battery. Requests go to the world, replies come back, each in a frame as on the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, Final, Generic, TypeAlias, TypeVar

import msgspec

from pancakes.errors import RemoteProtocolError
from pancakes.mesh.wire.framing import FrameReader, frame
from pancakes.packet import body_class
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed


class Attach(msgspec.Struct, tag_field="is", tag="attach", array_like=True, frozen=True):
    """A device begins to use a body; refused where that cannot be.

    Attributes:
        body: the body's name.
        device: the device's name, which stands on all replies to it.
        type: the device's type.
        model: the kind of robot that a drive believes it drives; empty for sensors.
    """

    body: str
    device: str
    type: str
    model: str = ""


class Drive(msgspec.Struct, tag_field="is", tag="drive", array_like=True, frozen=True):
    """The wheels are to run.

    Attributes:
        body: the robot's name.
        device: the device's name.
        left_mps: speed of the left wheel.
        right_mps: speed of the right wheel.
        ttl_s: for how long that is good, in mission seconds; the wheels stand afterwards.
        source: address of the task that commands it.
    """

    body: str
    device: str
    left_mps: float
    right_mps: float
    ttl_s: float
    source: str


class Halt(msgspec.Struct, tag_field="is", tag="halt", array_like=True, frozen=True):
    """The wheels are to stand at once."""

    body: str
    device: str


class Sample(msgspec.Struct, tag_field="is", tag="sample", array_like=True, frozen=True):
    """A sensor is asked.

    Attributes:
        body: the body's name.
        device: the device's name.
        type: the device's type.
        packets_sent: how many mission packets the body's agent has sent so far, told by the device that
            measures the battery.
        listening: whether the agent's Network Service is awake, told by the same device.
    """

    body: str
    device: str
    type: str
    packets_sent: int | None = None
    listening: bool | None = None


class Attached(msgspec.Struct, tag_field="is", tag="attached", array_like=True, frozen=True):
    """A device may use the body that it asked for."""

    device: str


class Reading(msgspec.Struct, tag_field="is", tag="reading", array_like=True, frozen=True):
    """What a sensor says: the body of a packet of the device's type."""

    device: str
    type: str
    value: Any


class RawReading(msgspec.Struct, tag_field="is", tag="reading", array_like=True, frozen=True):
    """A `Reading` as it arrives: its value is still packed, so that it is made into its class at once."""

    device: str
    type: str
    value: msgspec.Raw

    def body(self) -> Any:
        """Returns the body of the packet; plain values where its type is unknown here.

        Raises:
            RemoteProtocolError: the value does not fit the type.
        """
        try:
            return _decoder(body_class(self.type) or Any)(self.value)
        except MALFORMED as error:
            raise RemoteProtocolError(f"a packet of the type {self.type!r} has a bad body: {error}") from None


class Refused(msgspec.Struct, tag_field="is", tag="refused", array_like=True, frozen=True):
    """A request cannot be met, and why."""

    device: str
    reason: str


Request: TypeAlias = Attach | Drive | Halt | Sample
Reply: TypeAlias = Attached | Reading | Refused
Replied: TypeAlias = Attached | RawReading | Refused

_REQUESTS: Final[Callable[[Any], list[Request]]] = codecs.decoder(list[Request])
_REPLIES: Final[Callable[[Any], list[Replied]]] = codecs.decoder(list[Replied])
_Message = TypeVar("_Message")


@cache
def _decoder(cls: Any) -> Callable[[Any], Any]:
    return codecs.decoder(cls)


def encode(message: Request | Reply) -> bytes:
    """Returns a message as a frame."""
    return frame([codecs.encode(message)])


class BusReader(Generic[_Message]):
    """Makes messages of the bytes that come from the other end; see `RequestReader` and `ReplyReader`.

    Args:
        decode: makes the messages of a frame.
        called: what a message is called.
    """

    def __init__(self, decode: Callable[[Any], list[_Message]], called: str) -> None:
        self._frames = FrameReader()
        self._decode = decode
        self._called = called

    def feed(self, data: bytes) -> list[_Message]:
        """Takes bytes, and returns the messages that are now complete.

        Raises:
            RemoteProtocolError: the bytes are no such messages.
        """
        try:
            return [message for payload in self._frames.feed(data) for message in self._decode(payload)]
        except MALFORMED as error:
            raise RemoteProtocolError(f"that is no {self._called}: {why_malformed(error)}") from None


RequestReader: Final = partial(BusReader[Request], _REQUESTS, "request to a simulated world")
"""Makes requests of the bytes that come from one client."""
ReplyReader: Final = partial(BusReader[Replied], _REPLIES, "reply of a simulated world")
"""Makes replies of the bytes that come from a world."""
