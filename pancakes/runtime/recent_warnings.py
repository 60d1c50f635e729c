"""What an agent has warned of lately, each kind of line once: for `pancakes doctor`, which a person asks afterwards."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from typing import Any, Final

import msgspec

from pancakes.events import LogLine
from pancakes.packet import Packet

KEPT_S: Final = 600.0
"""A line is told for so long, in host seconds, ..."""
MOST_LINES: Final = 32
"""... and so many of them, the newest."""
MOST_LETTERS: Final = 400
_LEVELS: Final = ("warning", "error")
_PASSING: Final = re.compile(r"the link to \S+ has ended|no link over .*(reset by peer|broken pipe|has ended)")
"""What goes by with the next try: `doctor` sees for itself which peers have no link now."""
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?")


class _Line(msgspec.Struct):
    level: str
    text: str
    count: int
    last_s: float


class RecentWarnings:
    """Lines that differ in their numbers only are one. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lines: OrderedDict[tuple[str, str], _Line] = OrderedDict()

    def hear(self, packet: Packet, now_s: float) -> None:
        """Takes what was said on `log`; `now_s` is host time."""
        line = packet.body
        if not isinstance(line, LogLine) or line.level not in _LEVELS or _PASSING.match(line.text):
            return
        text = line.text[:MOST_LETTERS]
        key = packet.source, _NUMBER.sub("#", text)
        with self._lock:
            known = self._lines.pop(key, None)
            self._lines[key] = _Line(line.level, text, known.count + 1 if known is not None else 1, now_s)
            if len(self._lines) > MOST_LINES:
                self._lines.popitem(last=False)

    def told(self, now_s: float) -> list[dict[str, Any]]:
        """Returns the lines as plain values, the oldest first, with how long ago each was said last."""
        with self._lock:
            lines = list(self._lines.items())
        return [
            {"source": source, "level": it.level, "text": it.text, "count": it.count, "ago_s": now_s - it.last_s}
            for (source, _), it in lines
            if now_s - it.last_s <= KEPT_S
        ]
