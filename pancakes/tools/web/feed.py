"""Hold what a page shows: the model of a fleet, its history, and the frames for pages. Any thread."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final

from pancakes.control import Describe, Reply
from pancakes.packet import Cause
from pancakes.tools.short_state import shortened
from pancakes.tools.web.fleet_model import FleetModel
from pancakes.tools.web.series import thinned, unit
from pancakes.tools.web.timeline import ClockLine, FrameHistory, StateHistory
from pancakes.util import codecs

LONGEST_VALUE: Final = 80
"""The longest value in the state of a task, in characters; the rest is cut."""
FRAMES_HZ: Final = 10.0
"""How often, each second, pages get news and the history gets a frame."""
MOST_PLOTTED: Final = 1200
"""The most points of one series that a page gets at once; of more, the extremes of each piece."""


@dataclass(frozen=True, slots=True)
class Cursor:
    """How much a page has received.

    Attributes:
        version: the board's version.
        event: the number of the last event.
        knots: how many knots mission time had, see `ClockLine`.
    """

    version: int
    event: int
    knots: int = 0


class Feed:
    """The state of a fleet, for any number of pages. All methods may be called from any thread.

    Args:
        now: returns the present on the timeline, in seconds of the person who watches.

    Attributes:
        model: the model of the fleet; use it only with the lock.
        states: the states that tasks were seen with; use it only with the lock.
        lock: guards both.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self._present = now
        self._gap_s = 0.0
        self.lock = threading.Lock()
        self.model = FleetModel()
        self.states = StateHistory()
        self._history = FrameHistory()
        self._clock = ClockLine()
        self._recorded = 0
        self._recorded_s = -1.0
        self._waiting = ""
        self._over = ""

    def wait_for(self, reason: str) -> None:
        """Set why there is nothing to show yet; empty: there is something."""
        with self.lock:
            self._waiting = reason

    def end(self, sentence: str) -> None:
        """End the timeline at the present; `sentence` says how the run ended. Pages can still look at the past."""
        with self.lock:
            if not self._over:
                end_s = self.now()
                self.now = lambda: end_s
            self._over = sentence

    def go_on(self) -> None:
        """Continue the timeline after an `end`, without the gap in between."""
        with self.lock:
            if self._over:
                self._gap_s = self._present() - self.now()
                self.now = lambda: self._present() - self._gap_s
                self._over = ""

    @property
    def over(self) -> bool:
        """Whether the timeline has ended."""
        return bool(self._over)

    def record(self) -> None:
        """Add the present to the history if a frame is due. Call it at least `FRAMES_HZ` times a second."""
        t = self.now()
        if t - self._recorded_s < 0.999 / FRAMES_HZ:
            return
        with self.lock:
            self._recorded_s = t
            board = self.model.board
            whole = self._history.due(t)
            frame = self._frame(t, None if whole else self._recorded)
            self._recorded = board.version
            self._history.add(t, frame)
            if self.model.has_clock:  # else the line would begin with a jump from 0
                self._clock.add(t, frame["m"])

    def take_detail(self, agent: str, description: Mapping[str, Any]) -> None:
        """Take the result of `Describe` of one task, with its state."""
        state = description["state"]  # a word such as `stopped` if the task does not run
        short = shortened(state, most_chars=LONGEST_VALUE) if isinstance(state, Mapping) else None
        with self.lock:
            self.model.detail(agent, description)
            if short is not None:
                self.states.add(f"{agent}/{description['service']}/{description['task']}", self.now(), short)

    def chunk(self, t: float) -> bytes:
        """Return the piece of the history that contains `t`, see `FrameHistory.at`."""
        with self.lock:
            return self._history.at(t)

    def find_series(self, words: str, most: int) -> dict[str, Any]:
        """Return the series whose names contain all words, see `SeriesStore.find`; and follow all packets a while."""
        with self.lock:
            series = self.model.series
            series.want_all(self._present())
            rows, count = series.find(words, most)
            return {"rows": rows, "count": count, "left_out": series.left_out}

    def plot(self, names: Sequence[str], since: Sequence[float]) -> dict[str, Any]:
        """Return the points of series after a moment each, and follow their packets for a while.

        Returns:
            For each series that exists `[unit, times, values]`; a value is None in a gap.
        """
        with self.lock:
            series = self.model.series
            series.want(names, self._present())
            found = {
                name: points
                for name, t in zip(names, since, strict=True)
                if (points := series.after(name, t if math.isfinite(t) else -math.inf)) is not None
            }
        return {name: [unit(name), *thinned(*points, MOST_PLOTTED)] for name, points in found.items()}

    def wanted_packets(self) -> dict[str, tuple[str, ...]] | None:
        """Return which packets pages want, see `SeriesStore.wanted`."""
        with self.lock:
            return self.model.series.wanted(self._present())

    def frame(self, seen: Cursor | None) -> tuple[bytes, Cursor]:
        """Return what a page has not received yet as JSON, and its new cursor.

        Args:
            seen: the cursor of the page; None: it has received nothing, so it gets everything.
        """
        with self.lock:
            t = self.now()
            model = self.model
            cursor = Cursor(model.board.version, model.events.count, self._clock.changes)
            frame = self._frame(t, seen.version if seen is not None else None)
            events = model.events.since(seen.event if seen is not None else 0)
            if events:
                frame["events"] = events
            if seen is not None and events and events[0]["n"] > seen.event + 1:
                frame["lost_events"] = events[0]["n"] - seen.event - 1
            if seen is None or seen.knots != cursor.knots:
                frame["knots"] = self._clock.knots
            frame["from"] = round(self._history.begin_s(), 3)
            if self._waiting:
                frame["waiting"] = self._waiting
            if self._over:
                frame["over"] = self._over
            return codecs.encode_json(frame), cursor

    def _frame(self, t: float, version: int | None) -> dict[str, Any]:
        model = self.model
        frame: dict[str, Any] = {"t": round(t, 3), "m": round(model.mission_s(t), 2)}
        if version is None:
            frame["all"] = True
            frame["trails"] = {name: list(points) for name, points in model.trails.items()}
            frame["set"] = model.board.all()
        else:
            changed = model.board.since(version)
            if changed:
                frame["set"] = changed
        return frame


@dataclass(frozen=True)
class Shown:
    """What a page shows.

    Attributes:
        feed: the fleet.
        explain: returns why an agent's actuator was commanded; as `CommandExplainer.explain`, from any thread.
        look: asks an agent to describe a task, within a time limit; from any thread.
        order: sends an order to an agent, within a time limit; None: the page is read-only.
        title: the title of the page; empty: the fleet's name.
    """

    feed: Feed
    explain: Callable[[str, str, float | None, Cause | None, int], dict[str, Any] | None]
    look: Callable[[str, Describe, float], Future[Reply]]
    order: Callable[[str, Any, float], Future[Reply]] | None = None
    title: str = ""
