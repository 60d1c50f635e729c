"""Permits: until when each guarded task may act.

A permit is checked at the start of each turn, and when an act (command, packet, checkpoint) leaves the process. It is
over as soon as one of two clocks has passed its end, as a machine may have been suspended and a clock be wrong. Any
thread; one thread at a time for the permit of one task, except `hold_back`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, Literal, NamedTuple

import msgspec

from pancakes.packet import Fence

STEP_S: Final = 0.01
"""A clock that is disciplined is moved by less at a time; a wall clock that gains more on the other was set."""

Acts = Literal["commands", "packets", "checkpoints"]
"""What a task does that is seen outside of it."""


class PermitEnd(NamedTuple):
    """A moment by two clocks.

    Attributes:
        boot_s: the time since the machine has started, a suspend counted.
        wall_s: the time of day.
    """

    boot_s: float
    wall_s: float

    def later(self, delay_s: float) -> PermitEnd:
        """Return the moment this many host seconds after this one."""
        return PermitEnd(self.boot_s + delay_s, self.wall_s + delay_s)

    def left_s(self, now: PermitEnd) -> float:
        """Return how much time is left, in host seconds, by the clock that says less; none is left below zero."""
        return min(self.boot_s - now.boot_s, self.wall_s - now.wall_s)

    def step_s(self, now: PermitEnd) -> float:
        """Return by how much the time of day was set forward, if only that has ended the permit; else 0."""
        boot_s, wall_s = self.boot_s - now.boot_s, self.wall_s - now.wall_s
        return boot_s - wall_s if boot_s > 0 >= wall_s and boot_s - wall_s > STEP_S else 0.0


def moment_of_host() -> PermitEnd:
    """Return this moment by the two clocks of this machine."""
    return PermitEnd(time.clock_gettime(time.CLOCK_BOOTTIME), time.time())


_PAST: Final = PermitEnd(-1.0, -1.0)


class _Permit(msgspec.Struct):
    """The permit of one task.

    Attributes:
        epoch: the newest epoch under which the task was this agent's.
        until: the permit's end.
        told: what people were told of as held back since it was over last.
        held_back: how many acts were held back since this agent was started.
        steps: how often the time of day was set forward, and ended it.
    """

    epoch: tuple[int, str]
    until: PermitEnd = _PAST
    told: tuple[Acts, ...] = ()
    held_back: dict[Acts, int] = {}
    steps: int = 0


class Permits:
    """The permits of guarded tasks. Any thread; one thread at a time for the permit of one task but for `hold_back`.

    A permit is over as soon as either clock has passed its end: a machine may have been suspended, a clock be wrong.

    Args:
        moment: reads the clocks.
        say: takes a level and a line for `log`, from any thread.

    Attributes:
        moment: the same.
        by_task: the permits; empty, as on most agents: nothing needs to be asked.
    """

    def __init__(self, moment: Callable[[], PermitEnd], say: Callable[[str, str], None]) -> None:
        self.moment = moment
        self._say = say
        self.by_task: dict[str, _Permit] = {}

    def begin(self, fence: Fence) -> bool:
        """A guarded task is this agent's under an epoch. Returns whether that is a new one, under which it may not act
        before `give`.
        """
        permit = self.by_task.get(fence.task_id)
        new = permit is None or permit.epoch < fence.epoch
        if new:
            self.revoke(fence)
        return new

    def give(self, fence: Fence, until: PermitEnd) -> None:
        """Let a guarded task act until a moment."""
        permit = self._of(fence)
        permit.until, permit.told = until, ()

    def revoke(self, fence: Fence) -> None:
        """Let a guarded task act no more."""
        self._of(fence).until = _PAST

    def free(self, task_id: str) -> None:
        """Let a task act that is not guarded."""
        self.by_task.pop(task_id, None)

    def may_act(self, fence: Fence | None) -> bool:
        """Return whether what has this right may act now."""
        permit = self._asked(fence)
        return permit is None or permit.until.left_s(self.moment()) > 0

    def left_s(self, fence: Fence | None) -> float | None:
        """Return for how long what has this right may act yet, in host seconds; None: no permit limits that."""
        permit = self._asked(fence)
        return max(0.0, permit.until.left_s(self.moment())) if permit is not None else None

    def limited(self, fence: Fence, most_s: float) -> Fence:
        """Return a right that says for how long it is good, at most `most_s` host seconds, as other agents are told.

        That of a task which no permit limits says nothing, unless it came from another agent that has said so.
        """
        left_s, told_s = self.left_s(fence), fence.good_for_s
        if left_s is None and told_s is None:
            return fence
        limits_s = [limit_s for limit_s in (most_s, left_s, told_s) if limit_s is not None]
        return msgspec.structs.replace(fence, good_for_s=min(limits_s))

    def hold_back(self, fence: Fence, acts: Acts, count: int = 1) -> None:
        """Count acts that came too late, and log it if it is the first since the permit was over."""
        permit = self.by_task.get(fence.task_id)
        if permit is None:  # it is guarded no longer
            return
        permit.held_back[acts] = permit.held_back.get(acts, 0) + count
        if acts not in permit.told:
            permit.told += (acts,)
            self._say("warning", f"{fence.task_id} may not act until its guardians answer: its {acts} are held back")

    def held_back(self, task_id: str) -> dict[str, int]:
        """Return how many acts of a task were held back, by kind."""
        permit = self.by_task.get(task_id)
        return {str(acts): count for acts, count in permit.held_back.items()} if permit is not None else {}

    def ended_by_step(self, fence: Fence) -> float:
        """Return by how much the time of day was set forward, if that ended the permit, and count it; else 0."""
        permit = self._asked(fence)
        step_s = permit.until.step_s(self.moment()) if permit is not None else 0.0
        if permit is not None and step_s:
            permit.steps += 1
        return step_s

    def steps(self, task_id: str) -> int:
        """Return how often the time of day was set forward while this agent had a task, and ended its permit."""
        permit = self.by_task.get(task_id)
        return permit.steps if permit is not None else 0

    def _of(self, fence: Fence) -> _Permit:
        permit = self.by_task.get(fence.task_id)
        if permit is None:
            permit = self.by_task[fence.task_id] = _Permit(fence.epoch)
        permit.epoch = max(permit.epoch, fence.epoch)
        return permit

    def _asked(self, fence: Fence | None) -> _Permit | None:
        """Return the permit that a right rests on; None: none.

        A later epoch than this agent ever had is another agent's, whose commands come by here.
        """
        if fence is None or not self.by_task:
            return None
        permit = self.by_task.get(fence.task_id)
        return permit if permit is not None and fence.epoch <= permit.epoch else None
