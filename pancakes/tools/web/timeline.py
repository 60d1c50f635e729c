"""Keep what a page shows, and its last minutes: named values, frames of changes, and states of tasks. Pure.

A page with an older version of the `Board` gets all changes since. `FrameHistory` keeps pieces of the timeline that a
page fetches one by one. Times are seconds on the page's timeline.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.tools.short_state import ShortState
from pancakes.util import codecs


class Board:
    """Named plain values. A page with an older version gets all changes since, however old its version is.

    So the board stores nothing per page, and a slow page gets only the newest values.

    Attributes:
        version: increases with each change.
    """

    def __init__(self) -> None:
        self.version = 0
        self._entries: OrderedDict[str, tuple[int, Any]] = OrderedDict()

    def set(self, key: str, value: Any) -> None:
        """Set a value; an equal value is not a change. None removes it."""
        known = self._entries.get(key)
        if known[1] == value if known is not None else value is None:
            return
        self.version += 1
        self._entries[key] = (self.version, value)
        self._entries.move_to_end(key)

    def get(self, key: str) -> Any:
        """Return a value; None if there is none."""
        entry = self._entries.get(key)
        return entry[1] if entry is not None else None

    def keys(self, prefix: str = "") -> list[str]:
        """Return the names of the values that begin with `prefix`."""
        return [key for key, (_, value) in self._entries.items() if value is not None and key.startswith(prefix)]

    def since(self, version: int) -> dict[str, Any]:
        """Return the values that changed after a version, oldest change first; removed ones are None."""
        changed: list[tuple[str, Any]] = []
        for key, (when, value) in reversed(self._entries.items()):
            if when <= version:
                break
            changed.append((key, value))
        return dict(reversed(changed))

    def all(self) -> dict[str, Any]:
        """Return all values."""
        return {key: value for key, (_, value) in self._entries.items() if value is not None}


CHUNK_S: Final = 10.0
"""The length of one piece of the timeline, in seconds."""
SPAN_S: Final = 600.0
"""The length of the timeline that is kept, in seconds."""
MOST_BYTES: Final = 64 * 1024 * 1024
"""The most memory of the frames; beyond that the oldest piece is dropped."""


@dataclass(slots=True)
class _Chunk:
    """A piece of the timeline: all values at its beginning (`key`), and the changes since."""

    number: int
    begin_s: float
    key: bytes
    frames: list[bytes] = field(default_factory=list)
    size: int = 0


class FrameHistory:
    """Keep frames, each with the changes since the one before.

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
        """Return whether a new piece begins at `t`, so that this frame needs all values."""
        return not self._chunks or t - self._chunks[-1].begin_s >= CHUNK_S

    def add(self, t: float, frame: Any) -> None:
        """Keep a frame: with all values if a new piece is `due`, otherwise with the changes."""
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
        """Return the time at which the history begins."""
        return self._chunks[0].begin_s if self._chunks else 0.0

    def at(self, t: float) -> bytes:
        """Return the piece around `t` as JSON: `begin`, `end`, `open` (whether it still grows), `key`, `frames`.

        Before the beginning this is the first piece, after the end the last; `null` if there is none.
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


MOST_KNOTS: Final = 200
"""The most changes of the speed of mission time that are kept."""
KNOT_S: Final = 0.3
"""Mission time may differ by this many seconds from a straight line before a new line begins."""


class ClockLine:
    """Keep how mission time went along the timeline, as knots of a line: few, because its speed rarely changes.

    Attributes:
        knots: moments `t` of the timeline with their mission times, oldest first.
        changes: how many knots there were so far.
    """

    def __init__(self) -> None:
        self.knots: list[tuple[float, float]] = []
        self.changes = 0
        self._last = (0.0, 0.0)
        self._slope: float | None = None

    def add(self, t: float, mission_s: float) -> None:
        """Note the mission time at a moment; moments come in order."""
        if not self.knots:
            self._begin(t, mission_s)
        begin_t, begin_s = self.knots[-1]
        if self._slope is None and t - begin_t >= 1.0:  # a shorter line has no reliable slope
            self._slope = (mission_s - begin_s) / (t - begin_t)
        slope = self._slope
        if slope is not None and abs(begin_s + slope * (t - begin_t) - mission_s) > KNOT_S * max(1.0, slope):
            self._begin(*self._last)
        self._last = (t, mission_s)

    def _begin(self, t: float, mission_s: float) -> None:
        self.knots.append((round(t, 3), round(mission_s, 3)))
        self.changes += 1
        self._slope = None
        del self.knots[:-MOST_KNOTS]


MOST_STATE_BYTES: Final = 8 * 1024 * 1024
"""The most memory of the states; beyond that the oldest state is dropped."""


@dataclass(slots=True)
class _SeenState:
    """A state, and the first and last time that the task was seen with it."""

    first_s: float
    last_s: float
    state: ShortState


class StateHistory:
    """Keep the short states of tasks, as far back as the timeline. Times are seconds on it.

    Args:
        span_s: see `SPAN_S`.
        most_bytes: see `MOST_STATE_BYTES`.
    """

    def __init__(self, span_s: float = SPAN_S, most_bytes: int = MOST_STATE_BYTES) -> None:
        self._span_s = span_s
        self._most_bytes = most_bytes
        self._seen: dict[str, deque[_SeenState]] = {}
        self._order: deque[tuple[str, _SeenState]] = deque()
        self._size = 0

    def add(self, task: str, t: float, state: ShortState) -> None:
        """Note that a task was seen with a state.

        Args:
            task: its address, as `agent/service/task`.
            t: when; not earlier than in the call before.
            state: its state, shortened.
        """
        seen = self._seen.setdefault(task, deque())
        if seen and seen[-1].state == state:
            seen[-1].last_s = t
            return
        seen.append(_SeenState(t, t, state))
        self._order.append((task, seen[-1]))
        self._size += state.size()
        while len(self._order) > 1 and (self._order[0][1].last_s < t - self._span_s or self._size > self._most_bytes):
            self._forget_oldest()

    def at(self, task: str, t: float) -> tuple[float, ShortState] | None:
        """Return when a task was last seen, not after `t`, and its state then; None if it was not seen."""
        for seen in reversed(self._seen.get(task, ())):
            if seen.first_s <= t:
                return min(t, seen.last_s), seen.state
        return None

    def _forget_oldest(self) -> None:
        task, seen = self._order.popleft()
        self._size -= seen.state.size()
        of_task = self._seen[task]
        of_task.popleft()
        if not of_task:
            del self._seen[task]
