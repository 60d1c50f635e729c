"""What a tiny node does: it senses, and every now and then says so. Pure, and without anything of Pancakes.

The program `tiny_node` and the simulated tiny nodes are this, with a clock and a line.
"""

from __future__ import annotations

import math
from typing import Final

from pancakes_sensor_field.frame import MOTION, PERIOD, SIREN, TEMPERATURE, Decoder, Frame, encode

LEAST_PERIOD_S: Final = 0.1
LONGEST_PERIOD_S: Final = 3276.7
_COLDEST, _HOTTEST = -327.68, 327.67


class Mote:
    """One tiny node.

    It tells its temperature and whether something moves once in each report period; and at once when something begins
    or ceases to move, as a motion sensor wakes the processor. When its period is changed it says that it has it.

    Its siren sounds for as long as a command says, and then falls silent by itself: the dead-man switch that still
    works where its gateway is stopped or dead.

    Args:
        node: its number.
        period_s: its report period at first, in seconds.
    """

    def __init__(self, node: int, period_s: float = 10.0) -> None:
        self._node = node
        self._period_s = _possible(period_s)
        self._number = -1
        self._decoder = Decoder()
        self._celsius: float | None = None
        self._moving = False
        self._report_s = 0.0
        self._silent_s = math.inf

    @property
    def next_s(self) -> float:
        """When it will speak next if nothing happens until then."""
        return min(self._report_s, self._silent_s)

    @property
    def sounds(self) -> bool:
        """Whether its siren sounds."""
        return self._silent_s < math.inf

    def start(self, now_s: float) -> bytes:
        """Starts, or starts again after its power was gone. Returns what it sends."""
        self._number = -1
        self._report_s, self._silent_s = now_s + self._period_s, math.inf
        return self._say(PERIOD, round(self._period_s * 10))

    def sense(self, celsius: float, moving: bool) -> bytes:
        """Its sensors say something. Returns what it sends at once."""
        changed = moving != self._moving
        self._celsius, self._moving = celsius, moving
        return self._say(MOTION, int(moving)) if changed else b""

    def tick(self, now_s: float) -> bytes:
        """Time has passed. Returns what it sends."""
        said = b""
        if now_s >= self._silent_s:
            self._silent_s = math.inf
            said = self._say(SIREN, 0)
        if now_s < self._report_s:
            return said
        self._report_s = now_s + self._period_s
        if self._celsius is None:
            return said
        hundredths = round(100 * min(max(self._celsius, _COLDEST), _HOTTEST))
        return said + self._say(TEMPERATURE, hundredths) + self._say(MOTION, int(self._moving))

    def received(self, data: bytes, now_s: float) -> bytes:
        """Something came on its line. Returns what it sends."""
        said = b""
        for frame in self._decoder.feed(data):
            if frame.node == self._node and frame.kind == PERIOD and frame.value > 0:
                self._period_s = frame.value / 10
                self._report_s = min(self._report_s, now_s + self._period_s)
                said += self._say(PERIOD, frame.value)
            elif frame.node == self._node and frame.kind == SIREN and frame.value >= 0:
                self._silent_s = now_s + frame.value / 10 if frame.value else math.inf
                said += self._say(SIREN, frame.value)
        return said

    def _say(self, kind: int, value: int) -> bytes:
        self._number = self._number + 1 if self._number < 255 else 1
        return encode(Frame(self._node, kind, self._number, value))


def spoilt(data: bytes) -> bytes:
    """Return frames as a bad line would bring them: one bit of the first value is wrong."""
    return data[:5] + bytes((data[5] ^ 0x10,)) + data[6:]


def _possible(period_s: float) -> float:
    return min(max(period_s, LEAST_PERIOD_S), LONGEST_PERIOD_S)
