"""Decide how healthy a device is: which readings or commands failed, when that is too many, and whether it is silent.

One failed try does not end a device: a bus has noise, a chip is busy. Everything but the lock is pure. Any thread.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Annotated, Any, Final

import msgspec

ROUNDING_S: Final = 1e-9
"""A timer may fire too early by a rounding error; waiting for the rest would stop virtual time."""

Line = tuple[str, str]
"""A line for the log: its level, and its text."""


class MissRule(msgspec.Struct, frozen=True):
    """When a device fails that misses readings, or commands of an actuator.

    Attributes:
        in_a_row: after this number of misses in a row it fails, and is restarted.
        share: it also fails if this share is missed ...
        within_mission_s: ... within this many seconds of mission time, and at least `in_a_row` of them. The number of
            misses is logged at the same interval.
    """

    in_a_row: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 5
    share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5
    within_mission_s: Annotated[float, msgspec.Meta(gt=0, le=1e9)] = 30.0


def share_of(missed: int, tries: int) -> str:
    """Return which share of the tries were missed, for people: `3.3 %`, `99.7 %`, `100 %`."""
    percent = 100 * missed / tries
    return f"{percent:.{2 if percent < 10 else 3}g} %"


class Readings:
    """What has come of the tries of one device, since it was opened. Any thread.

    Args:
        rule: when it fails.
        noun: what a try is to bring: `reading`, or `command`.
        silent_s: after this time without a sound reading, in mission seconds, it is silent; None: never.
        now_s: mission time.
    """

    def __init__(self, rule: MissRule, noun: str, silent_s: float | None, now_s: float) -> None:
        self._rule = rule
        self._noun = noun
        self._silent_s = silent_s
        self._lock = threading.Lock()
        self._last_s = now_s
        self._silent = False
        self._came = 0
        self._missed = 0
        self._in_a_row = 0
        self._why = ""
        self._since_s = math.inf  # when the present count of misses began; none is under way: never
        self._tries_then = 0
        self._missed_then = 0
        self._told = 0  # misses of this count that the log knows of
        self._too_many = False

    def came(self, now_s: float) -> Sequence[Line]:
        """Take note of a sound reading; return what to log."""
        if self._since_s == math.inf and not self._silent:
            # Nothing was missed of late, so nothing but the count changes: no lock. If a driver delivers in two threads
            # at the same instant, one of the two readings may not be counted, which decides nothing.
            self._came += 1
            self._last_s = now_s
            return ()
        with self._lock:
            lines = self._count(now_s)
            self._came += 1
            self._in_a_row = 0
            return [*lines, *self._heard(now_s)]

    def missed(self, why: str, now_s: float) -> tuple[list[Line], bool]:
        """Take note of a miss; return what to log, and whether the device fails with it."""
        with self._lock:
            lines = self._count(now_s)
            if self._since_s == math.inf:
                self._begin_count(now_s, 1)
                lines.append(("warning", f"a {self._noun} is missed: {why}"))
            self._missed += 1
            self._in_a_row += 1
            self._why = why
            return lines, self._too_many or self._in_a_row >= self._rule.in_a_row

    def alive(self, now_s: float) -> list[Line]:
        """Take note of a sign of life that is not a reading; return what to log."""
        with self._lock:
            return self._heard(now_s)

    def look(self, now_s: float) -> tuple[float, bool, list[Line]]:
        """Check whether the device is silent.

        Returns:
            In how many seconds to check again, whether it is silent, and what to log.
        """
        with self._lock:
            if self._silent_s is None:
                return math.inf, False, []
            left_s = self._last_s + self._silent_s - now_s
            if left_s > ROUNDING_S:
                return left_s, False, []
            was, self._silent = self._silent, True
            text = f"no {self._noun} has come for {now_s - self._last_s:.1f} s of mission time"
            return self._silent_s, True, [] if was else [("warning", text)]

    def describe(self, now_s: float) -> dict[str, Any]:
        """Return what people may want to know, as plain values.

        Args:
            now_s: mission time.

        Returns:
            `came` and `missed`, counted since it was opened; `why` the last one was missed; `silent_s`: for how long
            nothing has come, None if that is not too long.
        """
        with self._lock:
            silent_s = now_s - self._last_s if self._silent else None
            return {"came": self._came, "missed": self._missed, "why": self._why, "silent_s": silent_s}

    def _heard(self, now_s: float) -> list[Line]:
        was, self._silent, self._last_s = self._silent, False, now_s
        return [("info", f"{self._noun}s come again")] if was else []

    def _begin_count(self, now_s: float, told: int) -> None:
        self._since_s, self._told = now_s, told
        self._tries_then, self._missed_then = self._came + self._missed, self._missed

    def _count(self, now_s: float) -> list[Line]:
        """End a count of misses whose time is over; return what to log."""
        rule = self._rule
        if now_s - self._since_s < rule.within_mission_s - ROUNDING_S:
            return []
        tries, missed = self._came + self._missed - self._tries_then, self._missed - self._missed_then
        lines: list[Line] = []
        if missed > self._told:
            share = f"{missed} of {tries} {self._noun}s ({share_of(missed, tries)})"
            lines = [("warning", f"{share} were missed in {now_s - self._since_s:.0f} s, the last one so: {self._why}")]
        self._too_many = missed >= rule.in_a_row and missed >= rule.share * tries
        self._begin_count(now_s if missed else math.inf, 0)
        return lines
