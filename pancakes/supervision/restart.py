"""Restart policies: when to start again what has ended. OTP's policies, with a growing back-off. Pure.

Tasks, devices, services and the processes of a launched fleet share them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, Literal, TypeAlias

import msgspec
from msgspec.structs import replace

LEAST: Final = 0.75
"""Each pause is drawn between this share of its length and all of it: what failed together does not return together."""

Draw = Callable[[float, float], float]
"""Draws a number between two, as `random.Random.uniform` does."""


Policy: TypeAlias = Literal["no", "on-failure", "always"]
"""When to start again what has ended, in the words of docker compose: for tasks, devices, services and processes."""


class RestartSpec(msgspec.Struct, frozen=True):
    """What follows when a task, a device or a service has ended by itself.

    Attributes:
        policy: `always`: it is started again; `on-failure`: only if it failed; `no`: never. A fleet file has the same
            words for the processes of agents.
        at_most: how many restarts are tried ...
        within_s: ... in this many seconds of host time in which it runs; one more failure, and it is given up. The
            pauses, and starts that fail, take none of this time.
        pause_s: how long the first restart waits, in seconds of host time. Each further one in `within_s` waits twice
            as long as the one before, less up to a quarter, by chance.
        pause_max_s: no restart waits longer than this.
        again_s: what was given up is tried again each time this many seconds have passed; 0: never.
    """

    policy: Policy = "always"
    at_most: int = 8
    within_s: float = 60.0
    pause_s: float = 0.1
    pause_max_s: float = 10.0
    again_s: float = 0.0


class DeviceRestartSpec(RestartSpec, frozen=True):
    """The same for a device, which is tried again after it was given up: its hardware may be plugged in later."""

    again_s: float = 60.0


def fault_of_pauses(pause_s: float, pause_max_s: float) -> str:
    """Say what is wrong with the longest pause; empty: nothing."""
    if pause_max_s >= pause_s:
        return ""
    return f"is {pause_max_s:g} s, less than the first pause (pause_s), which is {pause_s:g} s"


class Next(Enum):
    """What follows an end."""

    RESTART = "restart"
    REST = "rest"
    GIVE_UP = "give up"


class Restarts(msgspec.Struct, frozen=True):
    """The memory that a restart policy needs, for one task, service or process.

    Attributes:
        spec: the policy.
        failures: how often it has failed since it last ran well, for `within_s`, or was started on request.
        due_s: the host time of the next try; None: none is due.
        since_s: it runs since this host time; None: it does not run.
        ran_s: how long it has run in all. The next two are counted on this clock.
        restarts_s: when it was started again.
        failed_s: when it failed last.
    """

    spec: RestartSpec
    failures: int = 0
    due_s: float | None = None
    since_s: float | None = None
    ran_s: float = 0.0
    restarts_s: tuple[float, ...] = ()
    failed_s: float = 0.0

    def began(self, now_s: float) -> Restarts:
        """Return the memory after a start has succeeded."""
        return replace(self, since_s=now_s)

    def ended(
        self, failed: bool, now_s: float, draw: Draw, hopeless: bool = False, blameless: bool = False
    ) -> tuple[Next, Restarts]:
        """Decide what follows an end that was not asked for; `due_s` says when there is a next try.

        Args:
            failed: whether it ended by an error.
            now_s: host time.
            draw: draws the length of the pause.
            hopeless: whether each further try would end in the same way, as with settings that are wrong.
            blameless: whether that was no fault of its own; it is started again, whatever the policy.
        """
        spec = self.spec
        ran_s = self.ran_s + (now_s - self.since_s if self.since_s is not None else 0.0)
        if blameless:
            return Next.RESTART, replace(self, ran_s=ran_s, since_s=None, due_s=_due_s(now_s, spec.pause_s, draw))
        earliest_s = ran_s - spec.within_s
        failures = self.failures if self.failed_s > earliest_s else 0
        after = Restarts(
            spec,
            failures=failures + failed,
            ran_s=ran_s,
            restarts_s=tuple(time_s for time_s in self.restarts_s if time_s > earliest_s),
            failed_s=ran_s if failed else self.failed_s,
        )
        if spec.policy == "no" or (spec.policy == "on-failure" and not failed):
            return (Next.GIVE_UP if failed else Next.REST), after
        if hopeless:
            return Next.GIVE_UP, after
        number = len(after.restarts_s)
        if number < spec.at_most:
            pause_s = min(spec.pause_s * 2.0 ** min(number, 100), spec.pause_max_s)
            restarts_s = (*after.restarts_s, ran_s)
            return Next.RESTART, replace(after, restarts_s=restarts_s, due_s=_due_s(now_s, pause_s, draw))
        if spec.again_s:
            after = replace(after, due_s=_due_s(now_s, spec.again_s, draw))
        return Next.GIVE_UP, after

    def tried(self) -> Restarts:
        """Return the memory if the next try is made now, or called off."""
        return self if self.due_s is None else replace(self, due_s=None)

    def forgotten(self) -> Restarts:
        """Return the memory after a start or a stop was asked for: the failures so far do not count any more."""
        return (
            self.tried()
            if not (self.restarts_s or self.failures)
            else replace(self, restarts_s=(), failures=0, due_s=None)
        )

    def when(self, now_s: float) -> str:
        """Return when the next try is, as a phrase: `in 3.2 s`."""
        return f"in {max(0.0, (self.due_s or now_s) - now_s):.1f} s"

    def describe(self, now_s: float) -> dict[str, Any]:
        """Return what people may want to know, as plain values.

        Args:
            now_s: host time.

        Returns:
            `failures`, and `next_try_s`: in how many seconds of host time the next try is; None: none is due.
        """
        next_try_s = None if self.due_s is None else max(0.0, self.due_s - now_s)
        return {"failures": self.failures, "next_try_s": next_try_s}


def _due_s(now_s: float, pause_s: float, draw: Draw) -> float:
    return now_s + pause_s * draw(LEAST, 1.0)


def tries(described: Mapping[str, Any]) -> str:
    """Return what `Restarts.describe` says, for people: `failed 3 times, next try in 3.2 s`; empty: none is due."""
    failures, next_try_s = described.get("failures", 0), described.get("next_try_s")
    if next_try_s is None:
        return ""
    failed = f"failed {'once' if failures == 1 else f'{failures} times'}, " if failures else ""
    return f"{failed}next try in {next_try_s:.1f} s"
