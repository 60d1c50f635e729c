"""What can happen to a task that its agent hosts, besides the events of its life and of its hand-off."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.guards import GuardianId
from pancakes.runtime.hosting.hosting_effect import AskRoom


class StartConfigured(msgspec.Struct, frozen=True):
    """Its service begins, and starts it, or takes up the hand-off that its record tells of.

    Attributes:
        fresh: whether it is to begin as the configuration says, whatever its record says.
    """

    fresh: bool = False


class StartWanted(msgspec.Struct, frozen=True):
    """It is to run because another task has left; where its actuators are not free yet, it waits for them."""


class TakeUp(msgspec.Struct, frozen=True):
    """Its service begins, and it has no place there: only its record is left."""


class Room(msgspec.Struct, frozen=True):
    """The answer to `AskRoom`.

    Attributes:
        asked: what this answers.
        reason: why it cannot run here now; empty: it can.
        for_good: whether to try again is no use.
        snapshot: what it is to begin with, encoded; empty: what its record says.
        guardian: of a guarded task: its first guardian, where it is born now.
    """

    asked: AskRoom
    reason: str = ""
    for_good: bool = False
    snapshot: bytes = b""
    guardian: GuardianId | None = None


class PlaceFree(msgspec.Struct, frozen=True):
    """There is a place for it now: it was opened, or the task that had it is gone."""


class NoPlace(msgspec.Struct, frozen=True):
    """No place can be opened for it.

    Attributes:
        reason: why, as a sentence.
    """

    reason: str


class CameToRest(msgspec.Struct, frozen=True):
    """The answer to `WriteRest`.

    Attributes:
        snapshot: what it carried at the end, encoded; empty: what its record says.
    """

    snapshot: bytes


class Persisted(msgspec.Struct, frozen=True):
    """The record is on disk for good."""


class NotPersisted(msgspec.Struct, frozen=True):
    """The record could not be written.

    Attributes:
        reason: why.
    """

    reason: str


class StoodStill(msgspec.Struct, frozen=True):
    """The answer of its actor to `Freeze`.

    Attributes:
        offer: the hand-off.
        carried: what it carries, for `TakeDown`; None: it cannot say, and goes on.
        reason: why it cannot.
    """

    offer: Epoch
    carried: object = None
    reason: str = ""


class StillOverdue(msgspec.Struct, frozen=True):
    """It should stand still by now.

    Attributes:
        offer: the hand-off.
    """

    offer: Epoch


class PartConcluded(msgspec.Struct, frozen=True):
    """One of the two things that follow its hand-over is done."""


HostingEvent = (
    StartConfigured
    | StartWanted
    | TakeUp
    | Room
    | PlaceFree
    | NoPlace
    | CameToRest
    | Persisted
    | NotPersisted
    | StoodStill
    | StillOverdue
    | PartConcluded
)
