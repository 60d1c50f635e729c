"""The last minutes of what a page showed, in pieces that can be fetched one by one. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.runtime.foundation import codecs

CHUNK_S: Final = 10.0
"""How much of the timeline is one piece."""
SPAN_S: Final = 600.0
"""How much of it is kept."""
MOST_BYTES: Final = 64 * 1024 * 1024
"""How much memory that may take; then less is kept."""


@dataclass(slots=True)
class _Chunk:
    """A piece: all that was to be seen at its beginning, and the changes since."""

    number: int
    begin_s: float
    key: bytes
    frames: list[bytes] = field(default_factory=list)
    size: int = 0


class FrameHistory:
    """Keeps frames, each what changed since the one before.

    Args:
        span_s: see `SPAN_S`.
        most_bytes: see `MOST_BYTES`.
    """

    def __init__(self, span_s: float = SPAN_S, most_bytes: int = MOST_BYTES) -> None:
        self._span_s = span_s
        self._most_bytes = most_bytes
        self._chunks: deque[_Chunk] = deque()
        self._size = 0
        self._count = 0
        self._end_s = 0.0

    def due(self, t: float) -> bool:
        """Returns whether the frame at `t` needs everything, as a new piece begins with it."""
        return not self._chunks or t - self._chunks[-1].begin_s >= CHUNK_S

    def add(self, t: float, frame: Any) -> None:
        """Keeps a frame: one that has everything where that is `due`, else what changed."""
        data = codecs.encode_json(frame)
        if self.due(t):
            self._chunks.append(_Chunk(self._count, t, data))
            self._count += 1
        else:
            self._chunks[-1].frames.append(data)
        self._end_s = t
        self._chunks[-1].size += len(data)
        self._size += len(data)
        while len(self._chunks) > 1 and (self._chunks[1].begin_s < t - self._span_s or self._size > self._most_bytes):
            self._size -= self._chunks.popleft().size

    def begin_s(self) -> float:
        """Returns where on the timeline it begins."""
        return self._chunks[0].begin_s if self._chunks else 0.0

    def at(self, t: float) -> bytes:
        """Returns the piece around `t` as JSON: `begin`, `end`, `open` (whether it still grows), `key`, `frames`.

        Before the beginning that is the first one, after the end the last; `null` where there is none.
        """
        if not self._chunks:
            return b"null"
        found = 0
        for index, chunk in enumerate(self._chunks):
            if chunk.begin_s <= t:
                found = index
        chunk = self._chunks[found]
        last = found == len(self._chunks) - 1
        end_s = self._end_s if last else self._chunks[found + 1].begin_s
        return b'{"begin":%s,"end":%s,"open":%s,"key":%s,"frames":[%s]}' % (
            codecs.encode_json(chunk.begin_s),
            codecs.encode_json(end_s),
            b"true" if last else b"false",
            chunk.key,
            b",".join(chunk.frames),
        )
