"""What the machine of a hosted task asks for, besides the effects of its life and of its hand-off that it passes on."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration import effect as handoff_effect
from pancakes.mesh.migration.effect import StartTask
from pancakes.mesh.migration.epoch import Epoch
from pancakes.runtime.life import life_effect


class AskRoom(msgspec.Struct, frozen=True):
    """See whether it can run here now; to be answered, once, by `Room`.

    Attributes:
        keep: whether its actuators are to be kept for it from now on.
        again: whether it was running, and failed.
    """

    keep: bool
    again: bool


class OpenPlace(msgspec.Struct, frozen=True):
    """Open a place for it among the tasks; to be answered by `PlaceFree` or `NoPlace`.

    Attributes:
        start: what it is to be started from.
    """

    start: StartTask


class Prepare(msgspec.Struct, frozen=True):
    """Give its place what it begins with, and its actuators; to be answered by `Admitted` or `LeaveRefused`.

    Attributes:
        start: what it is to be started from.
    """

    start: StartTask


class Unreserve(msgspec.Struct, frozen=True):
    """Keep no actuators for it any longer; those that it holds it keeps."""


class Decided(msgspec.Struct, frozen=True):
    """Tell the requests that wait whether it starts.

    Attributes:
        reason: why it does not run; empty: it runs.
    """

    reason: str


class Lasts(msgspec.Struct, frozen=True):
    """Tell the requests that wait that all that was decided about it is on disk.

    Attributes:
        why_not: why it is not; empty: it is.
    """

    why_not: str = ""


class Rested(msgspec.Struct, frozen=True):
    """It has come to rest: where its service ends, the next task's turn has come."""


class TakeDown(msgspec.Struct, frozen=True):
    """It stands still: hold its actuators and write it down; to be answered by `Frozen` or `FreezeFailed`.

    Attributes:
        offer: the hand-off.
        carried: what it carries.
    """

    offer: Epoch
    carried: object


class LetGoOn(msgspec.Struct, frozen=True):
    """It stands still for a hand-off that was broken off: let it go on."""


class Drop(msgspec.Struct, frozen=True):
    """Forget what is owed for it and kept for it: it was given away, or never ran here.

    Attributes:
        ends: whether its actor is still to end; its actuators are taken from it at once.
    """

    ends: bool


class Vacate(msgspec.Struct, frozen=True):
    """Clear its place: it is elsewhere. Where others wait for the place, they are fed `PlaceFree`."""


Joined = life_effect.AskLeave | life_effect.Settle | life_effect.WriteRest | handoff_effect.OfLife
"""Effects of the one half that mean something for the other: the machine has a rule for each."""

PassedOn = (
    life_effect.Spawn
    | life_effect.TellToEnd
    | life_effect.Revoke
    | life_effect.LetGo
    | life_effect.TryAt
    | life_effect.LookAgain
    | life_effect.Settle
    | life_effect.WriteRest
    | life_effect.Answer
    | life_effect.Tell
)
"""Effects of a life that the machine passes on."""

SlotEffect = AskRoom | Prepare | Rested | TakeDown | LetGoOn | Vacate | handoff_effect.Freeze
"""Effects that are carried out at the slot of a task."""

HostingEffect = (
    OpenPlace
    | Unreserve
    | Decided
    | Lasts
    | Drop
    | handoff_effect.Persist
    | handoff_effect.Resume
    | handoff_effect.HandedOver
    | handoff_effect.OfHost
)
"""Effects that a task without a slot may have too."""
