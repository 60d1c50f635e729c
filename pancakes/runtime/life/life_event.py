"""What happens in a life."""

from __future__ import annotations

import msgspec

from pancakes.runtime.life.request import Request


class StartAsked(msgspec.Struct, frozen=True):
    """It is to run.

    Attributes:
        asker: the request for it; None: its keeper starts it.
    """

    asker: Request | None = None


class StopAsked(msgspec.Struct, frozen=True):
    """It is to end.

    Attributes:
        asker: the request for it; None: its keeper ends it, which says nothing about what is wanted of it.
        reason: why, for the log.
        again: whether it starts again after that, as for a restart.
    """

    asker: Request | None = None
    reason: str = ""
    again: bool = False


class Admitted(msgspec.Struct, frozen=True):
    """It has leave to start now.

    Attributes:
        incarnation: which start of it this is; 0: the next one.
    """

    incarnation: int = 0


class LeaveRefused(msgspec.Struct, frozen=True):
    """It has no leave to start.

    Attributes:
        reason: why, as a sentence.
        for_good: whether to try again is no use.
    """

    reason: str
    for_good: bool = False


class PutOff(msgspec.Struct, frozen=True):
    """It goes on to wait for leave, for a reason that people should know.

    Attributes:
        reason: what it waits for, as a sentence.
    """

    reason: str


class Began(msgspec.Struct, frozen=True):
    """It runs."""


class Finished(msgspec.Struct, frozen=True):
    """Its actor or process has ended, or could not be made.

    Attributes:
        text: how, in a line.
        failed: whether by an error.
        hopeless: whether each further try would end in the same way.
        closing: whether its keeper ends, so that nothing is started again.
        blameless: whether that was no fault of its own, as where the guardians of a task do not answer.
    """

    text: str
    failed: bool = False
    hopeless: bool = False
    closing: bool = False
    blameless: bool = False


class Overdue(msgspec.Struct, frozen=True):
    """It should have ended by now.

    Attributes:
        incarnation: which start of it was told to end.
    """

    incarnation: int


class TryDue(msgspec.Struct, frozen=True):
    """The time of a next try has come.

    Attributes:
        due_s: the host time that it was put off to; where another has been set since, or none, nothing happens.
    """

    due_s: float


class Retry(msgspec.Struct, frozen=True):
    """Time to look whether there is leave now."""


class Written(msgspec.Struct, frozen=True):
    """How it rests is on disk, or need not be.

    Attributes:
        why_not: why that may not last; empty: it will.
    """

    why_not: str = ""


Event = (
    StartAsked | StopAsked | Admitted | LeaveRefused | PutOff | Began | Finished | Overdue | TryDue | Retry | Written
)
