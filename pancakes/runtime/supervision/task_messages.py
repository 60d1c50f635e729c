"""What a service and the actors of its tasks tell each other: data, and nothing that the other could call."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

import msgspec

from pancakes.control import Configure, Describe, Reschedule, SetFence
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.post import Letter
from pancakes.packet import Fence, Packet
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.life.request import Request

_NONE: Mapping[str, Any] = {}


class Carried(msgspec.Struct, frozen=True):
    """What a task carries from one actor to the next, on this agent or on another.

    Attributes:
        settings: its settings, as plain values.
        state: its state, as plain values.
        periods_s: the periods of its timers, by method.
        heard: its duplicate filter: up to which number it has handled the packets addressed to it, by stream.
    """

    settings: Mapping[str, Any]
    state: Mapping[str, Any]
    periods_s: Mapping[str, float] = _NONE
    heard: Mapping[str, int] = _NONE


# What a service tells a task's actor.


class ChangeTask(msgspec.Struct, frozen=True):
    """Change, or say how you stand; to be answered by `Changed`.

    Attributes:
        request: the request that asks for it.
        body: what is to be done.
        carry: whether the answer is to say what the task carries after that.
    """

    request: Request
    body: Reschedule | Configure | Describe | SetFence
    carry: bool


class Look(msgspec.Struct, frozen=True):
    """Say what you carry; to be answered by `Looked`, unless the task stands still."""


class StandStill(msgspec.Struct, frozen=True):
    """Stand still, to be handed over; to be answered by `Stood`.

    Attributes:
        offer: the hand-off.
    """

    offer: Epoch


class GoOn(msgspec.Struct, frozen=True):
    """Go on after `StandStill`, or after a time without a permit.

    Attributes:
        fence: what its commands bear from now on; None: what they bear already.
    """

    fence: Fence | None = None


class Give(msgspec.Struct, frozen=True):
    """Handle a packet that is addressed to the task wherever it is; to be answered by `LetterGiven`.

    Attributes:
        letter: the letter that it came in.
        packet: what is in it; None: it is given up, and the next one may follow.
    """

    letter: Letter
    packet: Packet | None


# What a task's actor tells its service.


class HasNoPermit(msgspec.Struct, frozen=True):
    """A guarded task has found its permit over, and stands still from now on; to be answered by `GoOn` in time.

    Attributes:
        task: the actor.
    """

    task: Reference


class TaskBegan(msgspec.Struct, frozen=True):
    """It runs.

    Attributes:
        task: the actor.
    """

    task: Reference


class TaskEnded(msgspec.Struct, frozen=True):
    """It has ended.

    Attributes:
        task: the actor.
        error: why, where it failed; None: it was told to end.
        last: what it carried at the end; None: it could not say.
    """

    task: Reference
    error: BaseException | None
    last: Carried | None


class Changed(msgspec.Struct, frozen=True):
    """It has done what `ChangeTask` says, or refuses.

    Attributes:
        task: the actor.
        change: what it was told.
        reason: why it refuses; empty: it is done.
        result: what the reply says of it, as plain values; empty: nothing.
        carried: what the task carries after that; None: it was not asked, or cannot say.
    """

    task: Reference
    change: ChangeTask
    reason: str
    result: Mapping[str, Any]
    carried: Carried | None = None


class Looked(msgspec.Struct, frozen=True):
    """What it carries.

    Attributes:
        task: the actor.
        carried: what it carries; None: it cannot say.
        reason: why it cannot.
    """

    task: Reference
    carried: Carried | None
    reason: str = ""


class Stood(msgspec.Struct, frozen=True):
    """It stands still, or cannot be moved and goes on.

    Attributes:
        task: the actor.
        offer: the hand-off.
        carried: what it carries; None: it cannot say, and goes on.
        reason: why it cannot.
    """

    task: Reference
    offer: Epoch
    carried: Carried | None
    reason: str = ""


class LetterOutcome(Enum):
    """What has become of a packet that a task was given."""

    TAKEN = "taken"
    """It has had its effect, now or before."""
    EARLY = "early"
    """It is not its turn: the task stands still, or packets before it are missing. Its sender sends it again."""
    FAILED = "failed"
    """A handler raised, and the task fails."""


class LetterGiven(msgspec.Struct, frozen=True):
    """What has become of a packet.

    Attributes:
        task: the actor.
        give: what it was given.
        outcome: what has become of it.
    """

    task: Reference
    give: Give
    outcome: LetterOutcome
