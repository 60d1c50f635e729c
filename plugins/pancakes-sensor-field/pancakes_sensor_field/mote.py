"""The logic of a tiny node: it senses, and reports from time to time. Pure, and without imports of Pancakes.

The program `tiny_node` and the simulated tiny nodes use it, with a clock and a line.
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

    It reports its temperature and whether something moves once in each report period, and at once when something begins
    or ceases to move, because a motion sensor wakes the processor. It confirms a change of its period.

    Its siren sounds for the time in the command, and then falls silent by itself: a dead-man switch that still works if
    its gateway is paused or dead.

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
        """When it will send next if nothing happens before."""
        return min(self._report_s, self._silent_s)

    @property
    def sounds(self) -> bool:
        """Whether its siren sounds."""
        return self._silent_s < math.inf

    def start(self, now_s: float) -> bytes:
        """Start, also again after a power cut. Return what it sends."""
        self._number = -1
        self._report_s, self._silent_s = now_s + self._period_s, math.inf
        return self._say(PERIOD, round(self._period_s * 10))

    def sense(self, celsius: float, moving: bool) -> bytes:
        """Take readings of its sensors. Return what it sends at once."""
        changed = moving != self._moving
        self._celsius, self._moving = celsius, moving
        return self._say(MOTION, int(moving)) if changed else b""

    def tick(self, now_s: float) -> bytes:
        """Note that time has passed. Return what it sends."""
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
        """Take bytes from its line. Return what it sends."""
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
    """Return frames as a bad line would deliver them: one bit of the first value is wrong."""
    return data[:5] + bytes((data[5] ^ 0x10,)) + data[6:]


def _possible(period_s: float) -> float:
    return min(max(period_s, LEAST_PERIOD_S), LONGEST_PERIOD_S)
