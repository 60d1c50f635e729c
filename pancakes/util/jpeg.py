"""Read the size of a JPEG image from its header, without decoding it."""

from __future__ import annotations

from typing import Final

_START: Final = b"\xff\xd8"
_MARK: Final = 0xFF
_WITHOUT_LENGTH: Final = frozenset((0x01, *range(0xD0, 0xD8)))
"""Markers that no length follows: TEM and the restarts."""
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of frame headers, which have the size: SOF0 to SOF15 without DHT, JPG and DAC."""
_MOST_PARTS: Final = 1000
"""At most this many markers are looked at: a header has some dozens, and a long row of them must hold up nobody."""
_SCAN: Final = 0xDA
_END: Final = 0xD9


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return the width and height of a JPEG image in pixels.

    Raises:
        ValueError: it is not a JPEG image, or its header is cut off.
    """
    if data[:2] != _START:
        raise ValueError("the bytes are not a JPEG image: they do not begin with FF D8")
    at = 2
    for _ in range(_MOST_PARTS):
        if at + 4 > len(data) or data[at] != _MARK:
            break
        marker = data[at + 1]
        if marker == _MARK:  # a byte that fills up
            at += 1
        elif marker in _WITHOUT_LENGTH:
            at += 2
        elif marker in (_SCAN, _END):
            break
        elif marker in _FRAMES and at + 9 <= len(data):
            height, width = int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
            if width and height:
                return width, height
            break
        else:
            at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    raise ValueError("the JPEG image has no frame header that tells its size: it is cut off or damaged")
