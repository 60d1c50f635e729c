"""The gateway's side of a line with tiny nodes: bytes in, readings and answers out. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from pancakes_sensor_field.frame import MOTION, PERIOD, SIREN, TEMPERATURE, Decoder, Frame, encode

STARTED_ANEW: Final = 3
"""This many old numbers in a row mean that a node restarted and that its first frame was lost."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What one tiny node measured.

    Attributes:
        node: its name.
        kind: `TEMPERATURE` or `MOTION`.
        value: degrees Celsius; 1.0 or 0.0.
    """

    node: str
    kind: int
    value: float


@dataclass
class Heard:
    """The result of some bytes.

    Attributes:
        readings: the readings in them, in their order.
        answer: what to send back at once, while the nodes listen.
        speakers: the names of the nodes that sent.
        strangers: numbers of nodes that the settings do not name, each reported once.
    """

    readings: list[Reading] = field(default_factory=list)
    answer: bytes = b""
    speakers: set[str] = field(default_factory=set)
    strangers: list[int] = field(default_factory=list)


@dataclass
class _Node:
    """What is known of a tiny node."""

    name: str
    number: int | None = None
    period: int | None = None
    wanted: int | None = None
    late: list[int] = field(default_factory=list)


class Station:
    """Decode the frames of the tiny nodes on one line, and answer them.

    Args:
        nodes: the number of each node, by its name.
        period_s: the report period for all of them; None: their own.

    Attributes:
        missed: frames that never came, by the numbers of later ones.
        repeated: frames that came twice, or too late.
        unknown: frames of an unknown kind, or of a node that the settings do not name.
    """

    def __init__(self, nodes: Mapping[str, int], period_s: float | None = None) -> None:
        self.missed = 0
        self.repeated = 0
        self.unknown = 0
        self._decoder = Decoder()
        self._nodes = {number: _Node(name, wanted=_tenths(period_s)) for name, number in nodes.items()}
        self._strangers: dict[int, None] = {}

    @property
    def frames(self) -> int:
        """The number of complete frames."""
        return self._decoder.frames

    @property
    def crc_errors(self) -> int:
        """The number of frames with a wrong CRC."""
        return self._decoder.crc_errors

    @property
    def skipped_bytes(self) -> int:
        """The number of bytes that did not belong to a frame."""
        return self._decoder.skipped_bytes

    def want_period(self, period_s: float, name: str = "") -> bool:
        """Set the report period of a node, or of all. Each is told whenever it sends, until it confirms.

        Returns:
            Whether there is such a node.
        """
        meant = [node for node in self._nodes.values() if name in ("", node.name)]
        for node in meant:
            node.wanted = _tenths(period_s)
        return bool(meant)

    def received(self, data: bytes) -> Heard:
        """Take bytes from the line."""
        heard = Heard()
        for frame in self._decoder.feed(data):
            self._take(frame, heard)
        return heard

    def ended(self) -> None:
        """Drop an incomplete frame: the line was lost, or a datagram has ended."""
        self._decoder.end()

    def _take(self, frame: Frame, heard: Heard) -> None:
        node = self._nodes.get(frame.node)
        if node is None:
            self.unknown += 1
            if frame.node not in self._strangers:
                self._strangers[frame.node] = None
                heard.strangers.append(frame.node)
            return
        heard.speakers.add(node.name)
        if not self._is_next(node, frame):
            self.repeated += 1
            return
        if frame.kind == TEMPERATURE:
            heard.readings.append(Reading(node.name, TEMPERATURE, frame.value / 100))
        elif frame.kind == MOTION:
            heard.readings.append(Reading(node.name, MOTION, float(frame.value != 0)))
        elif frame.kind == PERIOD:
            node.period = frame.value
        elif frame.kind != SIREN:  # which confirms what was asked for
            self.unknown += 1
        if node.wanted is not None and node.wanted != node.period:
            heard.answer += encode(Frame(frame.node, PERIOD, frame.number, node.wanted))

    def _is_next(self, node: _Node, frame: Frame) -> bool:
        """Count the frames missing before this one; return whether it is a new one."""
        before, node.number = node.number, frame.number
        if before is None:
            return True
        if frame.number == 0:
            return before != 0
        ahead = (frame.number - before) % 255
        if 0 < ahead <= 127:
            self.missed += ahead - 1
            node.late.clear()
            return True
        # Over UDP a datagram may come twice, or be overtaken; several in a row mean that the node restarted without
        # being heard.
        in_a_row = node.late and frame.number == node.late[-1] + 1
        node.late = [*node.late, frame.number] if in_a_row else [frame.number]
        if len(node.late) < STARTED_ANEW:
            node.number = before
            return False
        node.late.clear()
        node.period = None
        return True


def _tenths(period_s: float | None) -> int | None:
    return None if period_s is None else round(10 * period_s)
