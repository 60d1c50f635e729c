"""The gateway's side of a line with tiny nodes: bytes in, readings and answers out. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from pancakes_sensor_field.frame import MOTION, PERIOD, SIREN, TEMPERATURE, Decoder, Frame, encode

STARTED_ANEW: Final = 3
"""So many old numbers in a row mean that a node counts anew, and that its first frame was lost."""


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
    """What some bytes meant.

    Attributes:
        readings: the readings in them, in their order.
        answer: what is to be sent back at once, while the nodes listen.
        speakers: the names of the nodes that spoke.
        strangers: numbers of nodes that the settings do not name, each told once.
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
    """Hear the tiny nodes of one line.

    Args:
        nodes: the number of each node, by its name.
        period_s: the report period that all of them are to have; None: what they have.

    Attributes:
        missed: frames that never came, as the numbers of later ones show.
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
        """Frames that came whole."""
        return self._decoder.frames

    @property
    def crc_errors(self) -> int:
        """How often a frame began whose CRC was wrong."""
        return self._decoder.crc_errors

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belonged to no frame."""
        return self._decoder.skipped_bytes

    def want_period(self, period_s: float, name: str = "") -> bool:
        """Let a node report in another period, or all of them; it is told when it next speaks, until it says so.

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
        """The line was lost, or a datagram has ended: what is incomplete stays so."""
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
        """Count what is missing before a frame; returns whether it is a new one."""
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
        # Over UDP a datagram may come twice, or be overtaken; several in a row are a node that started anew unheard.
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
