"""The wire format of the tiny nodes: eight bytes a frame, both ways. Pure, and without anything of Pancakes.

    byte    0      1      2      3      4 5      6 7
            sync   node   kind   number value    crc

`sync` is 0xA5. `node` is the node's number, 1 to 254: the sender's in a frame from it, else the receiver's.
`value` is a signed number, `crc` the CRC-16/CCITT-FALSE of bytes 1 to 5; both have the higher byte first.

| kind | from a node | to a node |
|---|---|---|
| 1 | its temperature, in hundredths of a degree Celsius | |
| 2 | 1: something moves; 0: nothing does | |
| 3 | its report period, in tenths of a second | its new report period |
| 4 | for how long its siren still sounds, in tenths of a second; 0: it is silent | for how long to sound |

A node counts its frames in `number`: 0 for the first after its start, then 1 to 255 over and over. A node listens just
after it has sent, as its radio costs power; its answers are sent then, with the number of the frame that they answer.
A node with a siren is on mains and listens all the time; it falls silent by itself when no other command comes in time.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from typing import Final

SYNC: Final = 0xA5
LENGTH: Final = 8
TEMPERATURE: Final = 1
MOTION: Final = 2
PERIOD: Final = 3
SIREN: Final = 4
NODES: Final = range(1, 255)

_VALUES: Final = range(-32768, 32768)
_LAYOUT: Final = struct.Struct(">BBBhH")


@dataclass(frozen=True, slots=True)
class Frame:
    """The contents of eight bytes.

    Attributes:
        node: the tiny node's number, 1 to 254.
        kind: what the value is, 0 to 255; see the module's docstring.
        number: the frame's number, 0 to 255.
        value: -32768 to 32767.
    """

    node: int
    kind: int
    number: int
    value: int


def encode(frame: Frame) -> bytes:
    """Return a frame's eight bytes.

    Raises:
        ValueError: one of its numbers does not fit.
    """
    if frame.node not in NODES or frame.value not in _VALUES:
        raise ValueError(f"{frame} does not fit into {LENGTH} bytes")
    try:
        head = bytes((frame.node, frame.kind, frame.number)) + frame.value.to_bytes(2, "big", signed=True)
    except ValueError:
        raise ValueError(f"{frame} does not fit into {LENGTH} bytes") from None
    return bytes((SYNC,)) + head + _crc(head).to_bytes(2, "big")


class Decoder:
    """Find the frames in a stream of bytes, which may contain other and wrong bytes.

    After bytes that are not a frame it looks for the next sync byte, also among those bytes. So it does not lose a good
    frame that follows a bad one in one piece, unless the first bytes of the good one happen to complete the bad one.

    Attributes:
        frames: how many frames it has found.
        crc_errors: how often a sync byte began something whose CRC was wrong.
        skipped_bytes: how many bytes did not belong to a frame.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.crc_errors = 0
        self.skipped_bytes = 0
        self._waiting = bytearray()

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes, in any pieces, and return the frames that are now complete."""
        waiting = self._waiting
        waiting += data
        found: list[Frame] = []
        while True:
            start = waiting.find(SYNC)
            self._skip(len(waiting) if start < 0 else start)
            if len(waiting) < LENGTH:
                return found
            node, kind, number, value, crc = _LAYOUT.unpack_from(waiting, 1)
            if crc != _crc(waiting[1:6]) or node not in NODES:
                self.crc_errors += 1
                self._skip(1)
                continue
            del waiting[:LENGTH]
            self.frames += 1
            found.append(Frame(node, kind, number, value))

    def end(self) -> None:
        """Drop an incomplete frame: a datagram has ended, or the line was lost."""
        self._skip(len(self._waiting))

    def _skip(self, count: int) -> None:
        del self._waiting[:count]
        self.skipped_bytes += count


def _crc(data: bytes | bytearray) -> int:
    return binascii.crc_hqx(data, 0xFFFF)
