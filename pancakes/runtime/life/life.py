"""Where something that an agent keeps running stands in its life."""

from __future__ import annotations

from enum import Enum
from typing import Final

import msgspec

from pancakes.runtime.life.request import Request
from pancakes.runtime.life.restart import Restarts


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
"""Why a task ends, or does not start, where its service ends."""


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
