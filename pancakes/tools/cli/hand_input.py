"""What a person's hands say: keys of a terminal and the stick of a gamepad become a share of the top speeds. Pure.

A terminal tells that a key is pressed, and again while it is held, but not that it is let go. So a key counts for a
moment, which is longer before the terminal begins to repeat it.
"""

from __future__ import annotations

import re
import struct
from typing import Final, NamedTuple

FIRST_S: Final = 0.6
"""How long a key counts that was just pressed: terminals repeat it after about half a second."""
AGAIN_S: Final = 0.2
"""How long a key counts that is repeated."""
FASTER: Final = 1.25
LEAST, MOST = 0.1, 4.0
"""The least and the largest factor of the top speeds."""
DEAD: Final = 0.12
"""A stick that is nearer to its centre, as a share of its way, is at its centre."""


class Share(NamedTuple):
    """How fast to go: the shares of the top speed, forward and counter-clockwise, each from -1 to 1."""

    forward: float = 0.0
    turn: float = 0.0


STILL: Final = Share()
_MOVES: Final = {
    "w": Share(1.0, 0.0),
    "s": Share(-1.0, 0.0),
    "a": Share(0.0, 1.0),
    "d": Share(0.0, -1.0),
    "q": Share(1.0, 1.0),
    "e": Share(1.0, -1.0),
}
_ARROWS: Final = {"A": "w", "B": "s", "D": "a", "C": "d"}
_SEQUENCE: Final = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|O[ -~])")
"""What a terminal sends for a key that is no character (ECMA-48); an arrow has a letter at the end."""
_BEGINNING: Final = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
"""The beginning of that, of which the rest has not come yet."""
_QUIT: Final = frozenset("x\x03\x04")
"""x, Ctrl-C and Ctrl-D."""
KEYS: Final = "W A S D or arrows: drive; Q, E: curves; space: stop; +, -: faster, slower; X or Ctrl-C: end"


class Keyboard:
    """Read the bytes of a terminal.

    Attributes:
        factor: of the top speeds.
        quits: whether the person has asked for the end.
        stops: how often a key was pressed that stops at once.
    """

    def __init__(self) -> None:
        self.factor = 1.0
        self.quits = False
        self.stops = 0
        self._key = ""
        self._until_s = 0.0
        self._rest = ""  # the beginning of an arrow key

    def take(self, data: bytes, now_s: float) -> None:
        """Take what was typed at a time, in seconds."""
        text = self._rest + data.decode(errors="ignore")
        self._rest = ""
        at = 0
        while at < len(text):
            if text[at] != "\x1b":
                self._press(text[at].lower(), now_s)
                at += 1
            elif sequence := _SEQUENCE.match(text, at):
                self._press(_ARROWS.get(sequence[0][-1], ""), now_s)
                at = sequence.end()
            elif _BEGINNING.match(text, at):
                self._rest = text[at:]
                if self._rest == "\x1b":
                    self._stop()  # it may be the key of that name
                return
            else:
                self._stop()
                at += 1

    def _press(self, key: str, now_s: float) -> None:
        if key in _QUIT:
            self.quits = True
        elif key in ("+", "="):
            self.factor = min(MOST, self.factor * FASTER)
        elif key in ("-", "_"):
            self.factor = max(LEAST, self.factor / FASTER)
        elif key in _MOVES:
            held = key == self._key and now_s < self._until_s
            self._key, self._until_s = key, max(self._until_s if held else 0.0, now_s + (AGAIN_S if held else FIRST_S))
        else:  # space, and every key that means nothing: a person who hits any key wants the robot to stop
            self._stop()

    def _stop(self) -> None:
        self._key = ""
        self.stops += 1

    def share(self, now_s: float) -> Share:
        """Return what the keys say at a time, in seconds."""
        return _MOVES[self._key] if self._key and now_s < self._until_s else STILL


EVENT: Final = struct.Struct("=IhBB")
"""An event of a joystick device of Linux: time, value, kind, number (linux/joystick.h)."""
_AXIS: Final = 2
_BEGINS: Final = 0x80
"""The events that tell, at the beginning, where all axes are have this bit as well."""
_FULL: Final = 32767.0


class Gamepad:
    """Read the events of a joystick device: the left stick drives, forwards is up."""

    def __init__(self) -> None:
        self._axes = {0: 0.0, 1: 0.0}
        self._rest = b""
        self._waits = False

    def stop(self) -> None:
        """Let the stick say nothing until it has been at its centre."""
        self._waits = any(self._axes.values())

    def take(self, data: bytes) -> None:
        """Take what was read of the device."""
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        for _, value, kind, number in EVENT.iter_unpack(data[:whole]):
            if kind & ~_BEGINS == _AXIS and number in self._axes:
                self._axes[number] = _without_centre(max(-1.0, value / _FULL))
                self._waits = self._waits and any(self._axes.values())

    def share(self) -> Share:
        """Return what the stick says."""
        return STILL if self._waits else Share(0.0 - self._axes[1], 0.0 - self._axes[0])


def _without_centre(value: float) -> float:
    if abs(value) <= DEAD:
        return 0.0
    return (value - DEAD if value > 0 else value + DEAD) / (1.0 - DEAD)
