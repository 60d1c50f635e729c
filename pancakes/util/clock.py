"""Clocks: the only module of Pancakes that asks the operating system for the time.

The host clock is monotonic and never scaled: handshakes, heartbeats, time-outs. The mission clock can be held at 0
and can be scaled: tasks, drivers, batteries, discovery, the time to live of a command. In virtual time both rest on
one `VirtualClock`. `SkewedClock` gives an agent of a test a bad clock.
"""

from __future__ import annotations

import math
import time
from typing import Final, Protocol


class Clock(Protocol):
    """A source of time, in seconds from its own origin."""

    def now(self) -> float:
        """Return the time in seconds. Never goes back."""
        ...


class MonotonicClock:
    """The host's monotonic clock."""

    now = staticmethod(time.monotonic)  # without a wrapper: the time is read very often


SET_SINCE_S: Final = 1_577_836_800.0
"""The year 2020: a clock with an earlier time of day was never set, as on a board without a battery."""
READ_S: Final = 0.0005
"""Two clocks must be read within this time, otherwise again: the thread may have been delayed in between."""


def day_s(host: Clock) -> float | None:
    """Return the time of day at 0 of the host clock, in seconds since 1970 (UTC); None: it was never set."""
    best: tuple[float, float] | None = None
    for _ in range(4):
        before_s = host.now()
        wall_s = time.time_ns() / 1e9
        took_s = host.now() - before_s
        if best is None or took_s < best[0]:
            best = (took_s, wall_s - before_s - took_s / 2)
        if took_s < READ_S:
            break
    assert best is not None
    return best[1] if best[1] + host.now() >= SET_SINCE_S else None


def utc_text(utc_s: float) -> str:
    """Return a time of day for people, as `2026-03-01 12:00:00.250`."""
    moment = time.gmtime(math.floor(utc_s))
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', moment)}.{int(utc_s % 1.0 * 1000):03d}"


def wall_ns() -> int:
    """Return the time of day in nanoseconds since 1970: only for times that people or other machines compare."""
    return time.time_ns()


class VirtualClock:
    """A clock that moves only on request (virtual time, tests).

    Attributes:
        now_s: the result of `now`, without a call.
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self.now_s = start_s

    def now(self) -> float:
        return self.now_s

    def advance_to(self, time_s: float) -> None:
        """Move the clock forward to `time_s`.

        Raises:
            ValueError: `time_s` lies in the past.
        """
        if time_s < self.now_s:
            raise ValueError(f"a clock cannot go back from {self.now_s} s to {time_s} s")
        self.now_s = time_s


class SkewedClock:
    """A clock that runs at another rate than the virtual one: to give agents bad clocks in tests.

    Args:
        true: the virtual clock.
        rate: its seconds for each second of the virtual clock.
        ahead_s: its time when the virtual clock is at 0.
    """

    def __init__(self, true: VirtualClock, rate: float, ahead_s: float = 0.0) -> None:
        if not (rate > 0 and math.isfinite(rate)):
            raise ValueError(f"a clock cannot run at {rate} times the true rate")
        if not (ahead_s >= 0 and math.isfinite(ahead_s)):
            raise ValueError(f"a host clock cannot begin at {ahead_s} s")
        self._true = true
        self.rate = rate
        self.ahead_s = ahead_s

    def now(self) -> float:
        return self.ahead_s + self._true.now_s * self.rate

    def true_s(self, time_s: float) -> float:
        """Return the first virtual time at which this clock has reached `time_s`."""
        found_s = (time_s - self.ahead_s) / self.rate
        # Rounding may make it less: a timer would come slightly too early, again and again.
        while self.ahead_s + found_s * self.rate < time_s:
            found_s = max(math.nextafter(found_s, math.inf), found_s + math.ulp(self.ahead_s) / self.rate)
        return found_s

    def due_s(self, delay_s: float) -> float:
        """Return the virtual time at which `delay_s` seconds of this clock will have passed."""
        return self.true_s(self.now() + delay_s)


class MissionClock:
    """The mission's time: 0 while held, then `speed` times as fast as the host clock.

    Args:
        host: the clock that it is based on.
        speed: mission seconds for each host second.
        held: whether it waits at 0 for `begin`; otherwise it runs from the start.

    Attributes:
        start_s: the mission time at which it began; 0, unless it took the time of other agents.
    """

    __slots__ = ("_host_now", "_origin_s", "speed", "start_s")  # every packet asks for the time

    def __init__(self, host: Clock, speed: float = 1.0, held: bool = False) -> None:
        if not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"a mission clock cannot run at {speed} times the host clock")
        self._host_now = host.now
        self.speed = speed
        self.start_s = 0.0
        self._origin_s = math.inf if held else host.now()

    @property
    def held(self) -> bool:
        """Whether the mission waits for `begin`."""
        return self._origin_s == math.inf

    def now(self) -> float:
        # In two steps: Python 3.11 treats a direct call as a method call, and searches the class first each time.
        host_now = self._host_now
        elapsed_s = host_now() - self._origin_s
        return elapsed_s * self.speed if elapsed_s > 0.0 else 0.0

    def begin(self, in_s: float = 0.0) -> None:
        """Start the mission in `in_s` seconds of host time. A running mission is left alone."""
        if self.held:
            self._origin_s = self._host_now() + in_s

    def join(self, zero_s: float) -> None:
        """Join the mission of other agents, at its time. A running mission is left alone: it never jumps.

        Args:
            zero_s: the host time at which their mission time was 0; it may be negative.
        """
        if self.held:
            self.start_s = max(0.0, (self._host_now() - zero_s) * self.speed)
            self._origin_s = zero_s

    def host_time(self, mission_s: float) -> float:
        """Return the host time at which the mission reaches `mission_s`; infinity while it is held."""
        return self._origin_s + mission_s / self.speed
