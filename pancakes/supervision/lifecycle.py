"""The life of a task, a service or a process: its states, events and effects. Pure.

`pancakes.supervision.lifecycle_table` decides what an event means in a state: it returns the new `Life` and a list of
effects. The supervisor (`Keeper`) carries the effects out, in this order. A `Request` is a control packet whose
sender waits for an answer.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

import msgspec

from pancakes.control import Command
from pancakes.packet import Cause
from pancakes.supervision.restart import Next, Restarts


class Request(msgspec.Struct, frozen=True):
    """The sender of a control packet, and which of its packets that was.

    Attributes:
        by: the sender's address.
        cause: the packet.
        number: its place in the order of all commands to this agent.
    """

    by: str
    cause: Cause
    number: int = 0


def request_of(command: Command) -> Request:
    """Return the request that a command carries out."""
    return Request(command.request[0], command.request, command.number)


class State(Enum):
    """How far a task, a service or a process is."""

    STOPPED = "stopped"
    """At rest."""
    REFUSED = "refused"
    """At rest, for want of a device, say; it is wanted, and tried again."""
    ASKED = "asked"
    """It is to start, and waits for leave: for its record to be on disk, or for those that come before it."""
    CALLED_OFF = "called off"
    """It was stopped while it waited for leave, and rests once that is settled."""
    STARTING = "starting"
    """Its actor is made, and has not begun."""
    RUNNING = "running"
    STOPPING = "stopping"
    """It was told to end."""
    STUCK = "stuck"
    """It was told to end and does not. Python cannot end its thread."""
    RESTARTING = "restarting"
    """It ended by itself; its next try is due."""
    FAILED = "failed"
    """It failed too often and is given up; with `again_s` a next try is due all the same."""


WORDS: Final = {
    **{state: state.value for state in State},
    State.REFUSED: "stopped",
    State.ASKED: "starting",
    State.CALLED_OFF: "stopping",
}
"""What people are told of each state."""

RESTS: Final = frozenset((State.STOPPED, State.REFUSED, State.FAILED))
"""The states in which nothing runs and nothing is under way."""
ACTOR: Final = frozenset((State.STARTING, State.RUNNING, State.STOPPING, State.STUCK))
"""The states in which a task has an actor."""
UNDECIDED: Final = frozenset((State.ASKED, State.CALLED_OFF))
"""The states in which it waits for leave."""

CLOSES: Final = "its service stops"
"""Why a task ends, or does not start, when its service ends."""


class Life(msgspec.Struct, frozen=True):
    """The life of one task, service or process; it outlives the actors that fill its place.

    Attributes:
        address: whose life it is; for sentences.
        restarts: the restart policy, and what it has to remember.
        state: how far it is.
        incarnation: how often it was started.
        wanted: whether it is to run, as far as its keeper knows. A stop that was asked for ends that, a failure or the
            end of its keeper does not.
        reason: why it does not run, or is about to end.
        asker: the request that is being carried out, and answered when that is done; until then others wait.
        again: whether it starts again once it has ended, as a restart asks for.
    """

    address: str
    restarts: Restarts
    state: State = State.STOPPED
    incarnation: int = 0
    wanted: bool = False
    reason: str = ""
    asker: Request | None = None
    again: bool = False

    @property
    def word(self) -> str:
        """The state, as people are told of it."""
        return WORDS[self.state]

    @property
    def at_rest(self) -> bool:
        """Whether nothing runs, is under way or is due."""
        return self.state in RESTS and self.restarts.due_s is None


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
        blameless: whether that was no fault of its own, as when the guardians of a task do not answer.
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
        due_s: the host time that it was put off to; if another has been set since, or none, nothing happens.
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


class AskLeave(msgspec.Struct, frozen=True):
    """See whether it may start; to be answered, once, by `Admitted` or `Refused`.

    Attributes:
        again: whether it was running, and failed.
    """

    again: bool


class Spawn(msgspec.Struct, frozen=True):
    """Make its actor, or its process."""


class TellToEnd(msgspec.Struct, frozen=True):
    """Tell it to end, and watch that it does (`Overdue`)."""


class Revoke(msgspec.Struct, frozen=True):
    """Take all its rights from it: it does not end, and no second copy may run beside it."""


class LetGo(msgspec.Struct, frozen=True):
    """Take back what it held."""


class TryAt(msgspec.Struct, frozen=True):
    """Feed `Due` at this host time."""

    due_s: float


class LookAgain(msgspec.Struct, frozen=True):
    """Feed `Retry` after a while."""


class Settle(msgspec.Struct, frozen=True):
    """A start is decided: it runs, or does not.

    Attributes:
        reason: why it does not run; empty: it does.
    """

    reason: str = ""


class WriteRest(msgspec.Struct, frozen=True):
    """It has come to rest: write down what is wanted of it, if that must outlive a crash; then feed `Written`."""


class Answer(msgspec.Struct, frozen=True):
    """Answer a request.

    Attributes:
        asker: the request.
        reason: why it is not done; empty: it is done.
    """

    asker: Request
    reason: str = ""


class News(Enum):
    """What a keeper tells on `log`."""

    REFUSED = "refused"
    STARTED = "started"
    FAILED = "failed"
    RESTARTS = "restarts"
    GIVEN_UP = "given up"
    FAILED_WHILE_STOPPING = "failed while it stopped"
    FAILED_AT_THE_END = "failed at the end"
    STOPPED = "stopped"
    STUCK = "stuck"


class Tell(msgspec.Struct, frozen=True):
    """Tell people and programs.

    Attributes:
        news: what has happened.
        text: why or how, in a line.
        following: after a failure, what the restart policy says.
        hopeless: whether each further try would end in the same way.
    """

    news: News
    text: str = ""
    following: Next | None = None
    hopeless: bool = False


Effect = AskLeave | Spawn | TellToEnd | Revoke | LetGo | TryAt | LookAgain | Settle | WriteRest | Answer | Tell
