"""Log buffers of an agent: what is logged before the Log Service runs, and recent warnings for `pancakes doctor`.

Links may come up before there is a Log Service (`EarlyLog`). `RecentWarnings` keeps each kind of warning once, with a
count, while its cause lasts. Any thread.
"""

from __future__ import annotations

import re
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes.durable.record import WAITS
from pancakes.events import LogLine
from pancakes.kernel.registry import TaskEntry, TaskTable
from pancakes.packet import Packet
from pancakes.supervision.lifecycle import State

MOST: Final = 1024
"""At most this many lines are kept until then; then the oldest is dropped."""


class EarlyLog:
    """Hold back log lines until the agent is ready, then log them in order: links may be up before. Any thread.

    Args:
        ready: set once the agent is ready.
    """

    def __init__(self, ready: threading.Event) -> None:
        self._ready = ready
        self._waiting: deque[Callable[[], None]] = deque(maxlen=MOST)

    def say(self, say: Callable[[], None]) -> None:
        """Call `say`: at once if the agent is ready, else once it is."""
        self._waiting.append(say)
        if self._ready.is_set():
            self.flush()

    def flush(self) -> None:
        """Call all that waits. Two threads may do so at once: each takes what it finds."""
        while self._waiting:
            try:
                say = self._waiting.popleft()
            except IndexError:
                return
            say()


KEPT_S: Final = 600.0
"""How long a line is kept, in host seconds."""
MOST_LINES: Final = 32
"""At most this many lines are kept, the newest."""
MOST_LETTERS: Final = 400
_LEVELS: Final = ("warning", "error")
_PASSING: Final = re.compile(r"the link to \S+ has ended|no link over .*(reset by peer|broken pipe|has ended)")
"""Faults that the next attempt may end: `doctor` itself checks which peers have no link now."""
_ANSWERS: Final = re.compile(r"what \S+ asked for \(#\d+\) was not done|.*, as \S+ asked\b", re.DOTALL)
"""Events that answer a request: its sender has the answer already."""
_BIRTHS: Final = re.compile(r"not born yet: |\S+ is born, although nothing was heard of it from ")
_REFUSED: Final = re.compile(r"\S+ (was not started: |is given up\b)")
_FAILED: Final = re.compile(r"\S+ (was not started: |is given up\b|is started again |failed (while it stopped|as its))")
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?")


class _Line(msgspec.Struct):
    level: str
    text: str
    count: int
    last_s: float
    task: tuple[str, str] | None


class RecentWarnings:
    """Keep recent warnings. Lines that differ only in their numbers count as one. Any thread.

    Args:
        tasks: the tasks of the agent: a line about a task is dropped once the task is gone or its trouble is over.
    """

    def __init__(self, tasks: TaskTable) -> None:
        self._tasks = tasks
        self._lock = threading.Lock()
        self._lines: OrderedDict[tuple[str, str], _Line] = OrderedDict()

    def take(self, packet: Packet, now_s: float) -> None:
        """Take a packet of `log`; `now_s` is host time."""
        line = packet.body
        if not isinstance(line, LogLine) or line.level not in _LEVELS:
            return
        if _PASSING.match(line.text) or _ANSWERS.match(line.text):
            return
        text = line.text[:MOST_LETTERS]
        key = packet.source, _NUMBER.sub("#", text)
        task = self._task_of(packet.source, text)
        with self._lock:
            known = self._lines.pop(key, None)
            self._lines[key] = _Line(line.level, text, known.count + 1 if known is not None else 1, now_s, task)
            if len(self._lines) > MOST_LINES:
                self._lines.popitem(last=False)

    def lines(self, now_s: float) -> list[dict[str, Any]]:
        """Return the lines as plain values, the oldest first, with how long ago each was last logged."""
        with self._lock:
            lines = list(self._lines.items())
        return [
            {"source": source, "level": it.level, "text": it.text, "count": it.count, "ago_s": now_s - it.last_s}
            for (source, _), it in lines
            if now_s - it.last_s <= KEPT_S and not self._is_over(it)
        ]

    def _task_of(self, source: str, text: str) -> tuple[str, str] | None:
        """Return the service and the name of the task that a line is about; None: of no existing task."""
        for address in (text.partition(" ")[0], source):
            agent, *parts = address.split("/")
            if agent == source.partition("/")[0] and len(parts) == 2 and self._tasks.get(*parts) is not None:
                return parts[0], parts[1]
        return None

    def _is_over(self, line: _Line) -> bool:
        """Return whether the task that a line is about is gone, or its trouble is over."""
        if _BIRTHS.match(line.text):
            return not any(entry.rest.startswith(WAITS) for entry in self._tasks.all())
        if line.task is None:
            return False
        entry = self._tasks.get(*line.task)
        return entry is None or _is_over_for(entry, line.text)


def _is_over_for(entry: TaskEntry, text: str) -> bool:
    """Return whether a line about the life of a task is out of date: the task runs, or rests as it should."""
    if entry.life.state is State.RUNNING:
        return _REFUSED.match(text) is not None
    return entry.life.state is State.STOPPED and not entry.life.wanted and _FAILED.match(text) is not None
