"""When what ended is started again: the decision, as OTP's supervisors make it, with a growing pause. Pure.

Tasks, devices, services and the processes of a launched fleet share it.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from enum import Enum
from typing import Any, Final, Literal

import msgspec

LEAST: Final = 0.75
"""Each pause is drawn between this share of its length and all of it: what failed together does not return together."""


class RestartSpec(msgspec.Struct, frozen=True):
    """What follows where a task, a device or a service has ended by itself.

    Attributes:
        policy: `permanent`: it is started again; `transient`: only where it failed; `temporary`: never.
        at_most: how many restarts are tried ...
        within_s: ... in so many seconds of host time in which it runs; one more failure, and it is given up. The
            pauses, and starts that fail, take none of this time.
        pause_s: how long the first restart waits, in seconds of host time. Each further one in `within_s` waits twice
            as long as the one before, less up to a quarter, by chance.
        pause_max_s: no restart waits longer than this.
        again_s: what was given up is tried again each time that so many seconds have passed; 0: never.
    """

    policy: Literal["permanent", "transient", "temporary"] = "permanent"
    at_most: int = 8
    within_s: float = 60.0
    pause_s: float = 0.1
    pause_max_s: float = 10.0
    again_s: float = 0.0


class DeviceRestartSpec(RestartSpec, frozen=True):
    """The same for a device, which is tried again after it was given up: its hardware may be plugged in later."""

    again_s: float = 60.0


def fault_of_pauses(pause_s: float, pause_max_s: float) -> str:
    """Says what is wrong with the longest pause; empty: nothing."""
    if pause_max_s >= pause_s:
        return ""
    return f"is {pause_max_s:g} s, less than the first pause (pause_s), which is {pause_s:g} s"


class Next(Enum):
    """What follows an end."""

    RESTART = "restart"
    REST = "rest"
    GIVE_UP = "give up"


class Supervision:
    """The memory that a restart policy needs, for one task, service or process.

    Attributes:
        spec: the policy.
        failures: how often it has failed since it last ran well, for `within_s`, or was started on request.
        due_s: the host time of the next try; None: none is due.
    """

    __slots__ = ("_failed_s", "_ran_s", "_restarts_s", "_since_s", "due_s", "failures", "spec")

    def __init__(self, spec: RestartSpec) -> None:
        self.spec = spec
        self.failures = 0
        self.due_s: float | None = None
        self._since_s: float | None = None  # it runs since then
        self._ran_s = 0.0  # how long it has run in all; the next two are counted on this clock
        self._restarts_s: tuple[float, ...] = ()
        self._failed_s = 0.0

    def runs(self, now_s: float) -> None:
        """Its start has succeeded."""
        self._since_s = now_s

    def ended(self, failed: bool, now_s: float, source: random.Random, hopeless: bool = False) -> Next:
        """Decides what follows an end that was not asked for; `due_s` says when there is a next try.

        Args:
            failed: whether it ended by an error.
            now_s: host time.
            source: the pause is drawn with it.
            hopeless: whether each further try would end in the same way, as with settings that are wrong.
        """
        spec = self.spec
        self.due_s = None
        if self._since_s is not None:
            self._ran_s += now_s - self._since_s
            self._since_s = None
        earliest_s = self._ran_s - spec.within_s
        self._restarts_s = tuple(time_s for time_s in self._restarts_s if time_s > earliest_s)
        if self._failed_s <= earliest_s:
            self.failures = 0
        if failed:
            self.failures += 1
            self._failed_s = self._ran_s
        if spec.policy == "temporary" or (spec.policy == "transient" and not failed):
            return Next.GIVE_UP if failed else Next.REST
        if hopeless:
            return Next.GIVE_UP
        number = len(self._restarts_s)
        if number < spec.at_most:
            self._restarts_s = (*self._restarts_s, self._ran_s)
            self._wait(now_s, min(spec.pause_s * 2.0 ** min(number, 100), spec.pause_max_s), source)
            return Next.RESTART
        if spec.again_s:
            self._wait(now_s, spec.again_s, source)
        return Next.GIVE_UP

    def _wait(self, now_s: float, pause_s: float, source: random.Random) -> None:
        self.due_s = now_s + pause_s * source.uniform(LEAST, 1.0)

    def take(self, due_s: float) -> bool:
        """The time of a try has come; returns whether it is still due. After that none is."""
        due = self.due_s == due_s
        if due:
            self.due_s = None
        return due

    def cancel(self) -> None:
        """No try is due any more: it is started now, or not at all."""
        self.due_s = None

    def hasten(self, now_s: float) -> float:
        """A start is asked for: a try is due now, and the failures so far are forgotten. Returns the time."""
        self.forget()
        self.due_s = now_s
        return now_s

    def forget(self) -> None:
        """Begins anew, as where a start or a stop is asked for."""
        self._restarts_s = ()
        self.failures = 0
        self.due_s = None

    def when(self, now_s: float) -> str:
        """Returns when the next try is, as a phrase: `in 3.2 s`."""
        return f"in {max(0.0, (self.due_s or now_s) - now_s):.1f} s"

    def describe(self, now_s: float) -> dict[str, Any]:
        """Returns what people may want to know, as plain values.

        Args:
            now_s: host time.

        Returns:
            `failures`, and `next_try_s`: in how many seconds of host time the next try is; None: none is due.
        """
        due_s = self.due_s  # it may be another thread that asks
        return {"failures": self.failures, "next_try_s": None if due_s is None else max(0.0, due_s - now_s)}


def tries(described: Mapping[str, Any]) -> str:
    """Returns what `Supervision.describe` says, for people: `failed 3 times, next try in 3.2 s`; empty: none is due."""
    failures, next_try_s = described.get("failures", 0), described.get("next_try_s")
    if next_try_s is None:
        return ""
    failed = f"failed {'once' if failures == 1 else f'{failures} times'}, " if failures else ""
    return f"{failed}next try in {next_try_s:.1f} s"
