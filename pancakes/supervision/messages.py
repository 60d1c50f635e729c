"""Messages between the agent, its root, its services, their tasks and the guardian: data, never functions.

Messages are sent with `tell` (`pancakes.kernel.actor`). Each docstring names the sender and the answer that it
expects.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any, Final

import msgspec

from pancakes.control import Checkpoints, Configure, Describe, Guarding, Refusal, Reschedule, SetFence, Take
from pancakes.durable.delivery import Letter
from pancakes.durable.snapshot import CarriedRequests
from pancakes.kernel.mailbox import Reference
from pancakes.packet import Cause, Fence, Packet
from pancakes.supervision.lifecycle import Request

_NONE: Mapping[str, Any] = {}


class Carried(msgspec.Struct, frozen=True):
    """What a task carries from one actor to the next, on this agent or on another.

    Attributes:
        settings: its settings, as plain values.
        state: its state, as plain values.
        periods_s: the periods of its timers, by method.
        heard: its duplicate filter: up to which number it has handled the packets addressed to it, by stream.
        requests: its open requests; None: it has none.
    """

    settings: Mapping[str, Any]
    state: Mapping[str, Any]
    periods_s: Mapping[str, float] = _NONE
    heard: Mapping[str, int] = _NONE
    requests: CarriedRequests | None = None


# What a service tells a task's actor.


class ChangeTask(msgspec.Struct, frozen=True):
    """Change, or say how you stand; to be answered by `Changed`.

    Attributes:
        request: the request that asks for it.
        body: what to do.
        carry: whether the answer is to say what the task carries after that.
    """

    request: Request
    body: Reschedule | Configure | Describe | SetFence
    carry: bool


class Look(msgspec.Struct, frozen=True):
    """Asks what the task carries. It answers with `Looked`, unless it is paused."""


class StandStill(msgspec.Struct, frozen=True):
    """Pause, so that the task can migrate; to be answered by `Stood`.

    Attributes:
        number: names the migration.
    """

    number: int


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


class RequestDue(msgspec.Struct, frozen=True):
    """A task tells itself that the time of a request is up, or that an answer may be sent again.

    Attributes:
        key: the request.
        asked: whether the task has made it; else it was asked.
        again: whether the answer must be sent again.
    """

    key: Cause
    asked: bool
    again: bool = False


# What a task's actor tells its service.


class HasNoPermit(msgspec.Struct, frozen=True):
    """A guarded task has found its permit over, and is paused from now on; to be answered by `GoOn` in time.

    Attributes:
        task: the actor.
    """

    task: Reference


class LoanChanged(msgspec.Struct, frozen=True):
    """An actuator that it holds is driven by hand from now on, or no longer: it looks whether it has to wait."""


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
        error: why, if it failed; None: it was told to end.
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
        refusal: why it refuses; None: it is done.
        result: what the reply says of it, as plain values; empty: nothing.
        carried: what the task carries after that; None: it was not asked, or cannot say.
    """

    task: Reference
    change: ChangeTask
    refusal: Refusal | None
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
    """It is paused, or cannot be moved and goes on.

    Attributes:
        task: the actor.
        number: names the migration.
        carried: what it carries; None: it cannot say, and goes on.
        reason: why it cannot.
    """

    task: Reference
    number: int
    carried: Carried | None
    reason: str = ""


class LetterOutcome(Enum):
    """What has become of a packet that a task was given."""

    TAKEN = "taken"
    """It has had its effect, now or before."""
    EARLY = "early"
    """It is not its turn: the task is paused, or packets before it are missing. Its sender sends it again."""
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


class Close(msgspec.Struct, frozen=True):
    """The root tells a service to stop its tasks and to end, or the agent the root to stop its services and to end.

    Attributes:
        for_s: after this many seconds of mission time the root starts the service again; None: it does not by itself.
    """

    for_s: float | None = None


class TryClasses(msgspec.Struct, frozen=True):
    """The root asks a service whether its tasks could go on in new classes; to be answered by `TasksReloaded`.

    Attributes:
        asker: the root.
        number: names the question.
        classes: the new classes, by type.
        version: the version that they are of.
    """

    asker: Reference
    number: int
    classes: Mapping[str, Any]
    version: str


class TakeClasses(msgspec.Struct, frozen=True):
    """The root has the tasks of a service go on in new classes; to be answered by `TasksReloaded`.

    Attributes:
        order: as `TryClasses`, with a number of its own.
        request: the request that asks for it.
        forgets: whether packets that wait for the tasks are dropped, because they may be of an old class.
    """

    order: TryClasses
    request: Request
    forgets: bool


class ReloadedTask(msgspec.Struct, frozen=True):
    """A task that goes on in its new class, or could.

    Attributes:
        service, task, type: the task.
        state: how it is, in a word.
        refusal: why it goes on in its old class, or does not run in the new one; None: it does, or would.
    """

    service: str
    task: str
    type: str
    state: str
    refusal: Refusal | None = None


class TasksReloaded(msgspec.Struct, frozen=True):
    """What a service answers `TryClasses` and `TakeClasses`.

    Attributes:
        service: the name of the service.
        number: as in what it answers.
        tasks: its tasks of these types.
    """

    service: str
    number: int
    tasks: tuple[ReloadedTask, ...]


class ServiceReady(msgspec.Struct, frozen=True):
    """A service tells the root that all tasks that start with it run, or do not.

    Attributes:
        service: the service's actor.
    """

    service: Reference


class ServiceEnded(msgspec.Struct, frozen=True):
    """A service tells the root that it has ended.

    Attributes:
        service: the service's actor.
        error: why, if it failed; None: it was told to end.
        kept: what its tasks carried last, by their names, for its next start.
        unheard: the requests that it has not answered.
    """

    service: Reference
    error: BaseException | None
    kept: Mapping[str, Carried]
    unheard: tuple[Request, ...]


class NoRoom(msgspec.Struct, frozen=True):
    """The agent tells the root that a control packet from elsewhere found no room here, or does not fit its type.

    Attributes:
        packet: the packet.
        refusal: why it was refused.
    """

    packet: Packet
    refusal: Refusal


class PeerDown(msgspec.Struct, frozen=True):
    """The agent tells the services that have to do with other agents that one has gone.

    Attributes:
        peer: the other agent.
    """

    peer: str


GUARDIAN: Final = "kernel/Registrar"
"""Where on each agent the registrar is, which knows the tasks that the agent guards."""


class AskedOfGuardian(msgspec.Struct, frozen=True):
    """The root hands on a request; to be answered by `GuardianAnswers`.

    Attributes:
        body: what is asked.
        request: the request.
        root: the root.
    """

    body: Guarding | Checkpoints | Take
    request: Request
    root: Reference

    @property
    def dry_run(self) -> bool:
        """Whether there is nothing to do."""
        return isinstance(self.body, Take) and self.body.dry_run


class GuardianAnswers(msgspec.Struct, frozen=True):
    """The guardian has done what was asked of it.

    Attributes:
        request: the request.
        refusal: why it was not done; None: it was.
        result: the answer, as plain values.
    """

    request: Request
    refusal: Refusal | None = None
    result: Any = None
