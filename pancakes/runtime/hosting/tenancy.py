"""What a service has at hand of a guarded task that it owns, or is to take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from pancakes.mesh.guarding.choosing import CanGuard
from pancakes.mesh.guarding.seizing import Seizing
from pancakes.mesh.guarding.tenure import Owed, Tenure
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.guard_rule import GuardRule
from pancakes.mesh.migration.guards import GuardianId
from pancakes.runtime.hosting.deadlines import Deadline
from pancakes.runtime.kernel.permits import PermitEnd
from pancakes.runtime.kernel.timer import OneShot

RULELESS_S: Final = 1.0
"""How often a task is written down that is to be guarded no longer."""


class Tenancy(msgspec.Struct):
    """A crash forgets all of it.

    Attributes:
        renewal: asks for leases again.
        end: the end of the permit.
        tenure: what its guardians have said.
        lost_s: since when, in host time, it may not act.
        type: entry point name of the task's class.
        rule: how the task is guarded; None: it is to be guarded no longer.
        until: until when each asking would let the task act, by beat; without those that a quorum has granted.
        told: the epoch, the checkpoint and the guards that guardians were told of last.
        bodies: which checkpoint each guardian was sent last, and with which beat.
        heard_s: when each guardian has said something last, in host time.
        as_of_s: when the task was known last to be as each of the newest checkpoints says, in host time, by number.
        owed: packets that are acknowledged once the checkpoint with their effect is at a quorum.
        stops: of each stop that is not answered yet, the checkpoint that says so, and what answers it, given a fault.
        answers: what neighbours have said that were asked whether they would guard it.
        asked_s: when they were asked last, in host time.
        unsafe: the actuators that people were told of as keeping their last command.
        thin: whether people were told that it has fewer guardians than it should.
    """

    renewal: Deadline
    end: Deadline
    tenure: Tenure
    lost_s: float
    type: str = ""
    rule: GuardRule | None = None
    until: dict[int, PermitEnd] = {}
    told: tuple[Epoch, int, int] | None = None
    bodies: dict[GuardianId, tuple[int, int]] = {}
    heard_s: dict[GuardianId, float] = {}
    as_of_s: dict[int, float] = {}
    owed: list[Owed] = []
    stops: list[tuple[int, Callable[[str], None]]] = []
    answers: dict[str, CanGuard] = {}
    asked_s: float = -1e9
    unsafe: frozenset[str] = frozenset()
    thin: bool = False

    @property
    def lease_s(self) -> float:
        """How long its leases are, in host seconds."""
        return self.rule.lease_s if self.rule is not None else GuardRule(3).lease_s

    @property
    def checkpoint_s(self) -> float:
        """How often the task is written down where it has changed, in host seconds."""
        return self.rule.checkpoint_s if self.rule is not None else RULELESS_S

    @property
    def number(self) -> int:
        """How many guardians it is to have."""
        return self.rule.guard if self.rule is not None else 1

    def cancel(self) -> None:
        """Ends its timers."""
        self.renewal.cancel()
        self.end.cancel()


class Taking(msgspec.Struct):
    """A task that this agent is to take.

    Attributes:
        seizing: what its guardians have said.
        until_s: when it is given up, in host time; None: never, as it was given away to this agent.
        again: asks once more.
    """

    seizing: Seizing
    until_s: float | None
    again: OneShot | None = None
