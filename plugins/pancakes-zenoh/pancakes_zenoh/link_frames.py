"""What travels between two sessions for one link: frames, each one message of Zenoh. Pure.

    frame = kind u8, number of the link u64, offset u64, waiting u32, data        (big endian)

| kind | offset | waiting | data |
|---|---|---|---|
| OPEN | 0 | 0 | the id of the session that dials, a space, `HOST/PORT` that it dials |
| DATA | how many bytes of the link went before | how many more wait at the sender | bytes of the link |
| GRANT | how many bytes of the link may be sent, counted from its beginning | 0 | none |
| FIN | how many bytes of the link there were | 0 | none |
| BREAK | 0 | 0 | why, as a phrase |
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import Final

import msgspec

PIECE_BYTES: Final = 60 * 1024
"""Most bytes of a link in one frame. Zenoh takes larger messages apart from 64 KiB on, and may then lose a part."""
LONGEST_PHRASE: Final = 512
_MOST_DATA: Final = (LONGEST_PHRASE, PIECE_BYTES, 0, 0, LONGEST_PHRASE)
"""By the kinds of frames."""
_HEAD: Final = struct.Struct("!BQQI")
_OPENING: Final = re.compile(r"([0-9a-f]{1,32}) ([A-Za-z0-9._-]{1,240}/[0-9]{1,5})")
MOST_WAITING: Final = 2**32 - 1


class FrameKind(IntEnum):
    """What a frame is for."""

    OPEN = 0
    DATA = 1
    GRANT = 2
    FIN = 3
    BREAK = 4


class LinkFrame(msgspec.Struct, frozen=True):
    """One frame; see the module for what its parts mean."""

    kind: FrameKind
    link: int
    offset: int = 0
    waiting: int = 0
    data: memoryview = memoryview(b"")

    def opening(self) -> tuple[str, str]:
        """Returns the session that dials and what it dials, of a frame OPEN.

        Raises:
            BadFrame: it says neither.
        """
        found = _OPENING.fullmatch(str(self.data, "ascii", "replace"))
        if found is None:
            raise BadFrame("it does not say who dials, and what", self.link)
        return found[1], found[2]


class BadFrame(ValueError):
    """Bytes that are no frame.

    Attributes:
        link: the link that they are about; None: they do not say.
    """

    def __init__(self, why: str, link: int | None) -> None:
        super().__init__(why)
        self.link = link


def frame_bytes(kind: FrameKind, link: int, offset: int, waiting: int, *parts: bytes | memoryview) -> bytes:
    """Returns a frame as it travels."""
    return b"".join((_HEAD.pack(kind, link, offset, min(waiting, MOST_WAITING)), *parts))


def frame_of(data: bytes) -> LinkFrame:
    """Reads a frame.

    Raises:
        BadFrame: it is none; the phrase says why.
    """
    if len(data) < _HEAD.size:
        raise BadFrame(f"it has {len(data)} bytes, and a frame has {_HEAD.size} at least", None)
    kind, link, offset, waiting = _HEAD.unpack_from(data)
    body = memoryview(data)[_HEAD.size :]
    if kind >= len(_MOST_DATA):
        raise BadFrame(f"it is of the kind {kind}, which there is not", link)
    if len(body) > _MOST_DATA[kind]:
        raise BadFrame(f"it has {len(body)} bytes of data, too many for a frame {FrameKind(kind).name}", link)
    return LinkFrame(FrameKind(kind), link, offset, waiting, body)
