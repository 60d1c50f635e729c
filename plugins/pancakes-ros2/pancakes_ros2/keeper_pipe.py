"""What a device and its goal keeper say to each other, and the pipe between the two processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import IO, Any, Final, TypeVar

import msgspec

from pancakes.util import codecs
from pancakes_ros2.goal_packets import GoalState

_T = TypeVar("_T")
_HEAD: Final = 4
MOST_BACKLOG: Final = 1 << 20
"""The most bytes that wait for a process that does not read; no goal is longer."""


class Setup(msgspec.Struct, frozen=True):
    """What a keeper is for; the first that it is told.

    Attributes:
        agent, device: whose goals it keeps.
        action: the type of the action.
        name: the name of the action; a relative one is below the agent's namespace.
        feedback_hz: how many feedback messages a second are passed on at most.
    """

    agent: str
    device: str
    action: str
    name: str
    feedback_hz: float


class Command(msgspec.Struct, frozen=True, tag="command"):
    """A goal is wanted.

    Attributes:
        task: the task that wants it.
        number: its number.
        fields: its fields; None: cancel it.
        until_s: how long, by the monotonic clock that the processes of a machine share.
    """

    task: str
    number: int
    fields: dict[str, Any] | None
    until_s: float


class Again(msgspec.Struct, frozen=True, tag="again"):
    """The goal of the command before is still wanted, until then: a goal may be long, and is repeated often."""

    until_s: float


class Hold(msgspec.Struct, frozen=True, tag="hold"):
    """No goal is wanted any more."""


class Status(msgspec.Struct, frozen=True, tag="status"):
    """How a goal stands; see `GoalStatus`."""

    task: str
    number: int
    state: GoalState
    text: str = ""
    feedback: dict[str, Any] | None = None
    result: dict[str, Any] | None = None


class Warned(msgspec.Struct, frozen=True, tag="warning"):
    """A line for the log of the agent."""

    text: str


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """It takes orders now."""


class Alive(msgspec.Struct, frozen=True, tag="alive"):
    """It is at work."""


class Failure(msgspec.Struct, frozen=True, tag="failure"):
    """It cannot keep any goal, and ends."""

    text: str


class PipeWriter:
    """Writes to a pipe and never waits for the one who reads. One thread at a time.

    Args:
        number: its file descriptor.
    """

    def __init__(self, number: int) -> None:
        os.set_blocking(number, False)
        self._number = number
        self._backlog = bytearray()

    def put(self, body: msgspec.Struct) -> bool:
        """Writes something, now or later; returns False, and leaves it out, if too much waits already.

        Raises:
            OSError: nobody reads any more.
        """
        if len(self._backlog) > MOST_BACKLOG:
            self.flush()
            if len(self._backlog) > MOST_BACKLOG:
                return False
        data = codecs.encode(body)
        self._backlog += len(data).to_bytes(_HEAD, "big") + data
        self.flush()
        return True

    @property
    def waits(self) -> bool:
        """Whether something waits to be written: call `flush` again soon."""
        return bool(self._backlog)

    def flush(self) -> None:
        """Writes what waits, as far as there is room for it.

        Raises:
            OSError: nobody reads any more.
        """
        while self._backlog:
            try:
                written = os.write(self._number, self._backlog)
            except BlockingIOError:
                return
            del self._backlog[:written]


def read_all(stream: IO[bytes], kind: type[_T] | Any) -> Iterator[Any]:
    """Yields what comes from a pipe, until its other end is closed, by purpose or by the end of its process."""
    decode = codecs.decoder(kind)
    while len(head := stream.read(_HEAD)) == _HEAD:
        length = int.from_bytes(head, "big")
        data = stream.read(length)
        if len(data) < length:
            return  # its writer died in the middle
        yield decode(data)
