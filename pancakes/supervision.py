"""When a task that ended is started again: the decision, as OTP's supervisors make it. Pure."""

from __future__ import annotations

from enum import Enum
from typing import Literal

import msgspec


class RestartSpec(msgspec.Struct, frozen=True):
    """What a service does when a task has ended by itself.

    Attributes:
        policy: `permanent`: it is started again; `transient`: only where it failed; `temporary`: never.
        at_most: how many restarts are tried ...
        within_s: ... in so many seconds of host time; one more failure, and the task is given up.
    """

    policy: Literal["permanent", "transient", "temporary"] = "permanent"
    at_most: int = 3
    within_s: float = 5.0


class Next(Enum):
    """What follows the end of a task."""

    RESTART = "restart"
    REST = "rest"
    GIVE_UP = "give up"


class Supervision:
    """The memory that a restart policy needs, for one task."""

    __slots__ = ("_restarts_s", "spec")

    def __init__(self, spec: RestartSpec) -> None:
        self.spec = spec
        self._restarts_s: tuple[float, ...] = ()

    def ended(self, failed: bool, now_s: float) -> Next:
        """Decides what follows an end that nobody asked for.

        Args:
            failed: whether it ended by an error.
            now_s: host time.
        """
        policy = self.spec.policy
        if policy == "temporary" or (policy == "transient" and not failed):
            return Next.GIVE_UP if failed else Next.REST
        self._restarts_s = tuple(time_s for time_s in self._restarts_s if time_s > now_s - self.spec.within_s)
        if len(self._restarts_s) >= self.spec.at_most:
            return Next.GIVE_UP
        self._restarts_s = (*self._restarts_s, now_s)
        return Next.RESTART

    def forget(self) -> None:
        """Begins anew: somebody asked for a start."""
        self._restarts_s = ()
