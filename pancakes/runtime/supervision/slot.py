"""The place of one task in its service."""

from __future__ import annotations

import msgspec

from pancakes.control import Command
from pancakes.packet import Fence
from pancakes.runtime.kernel.mailbox import Mailbox
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.life.life import Life
from pancakes.runtime.life.request import Request
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.task import TaskSpec


class Failure(msgspec.Struct, frozen=True):
    """How a task failed.

    Attributes:
        text: in one line, with the line of its author's code.
        traceback: the whole of it.
        t_s: the mission time.
    """

    text: str
    traceback: str
    t_s: float


class Slot(msgspec.Struct):
    """The place of one task in its service: it outlives the actors that fill it.

    Requests and commands stand in tuples: empty ones cost nothing, and empty lists and a deque for each of ten thousand
    tasks are 11 MiB.

    Attributes:
        name: the task's name.
        life: how far the task is.
        task: its actor; None: none runs.
        carried: what its next actor begins with; None: what the configuration says.
        rest: of a task that can move and does not run: why, in a word.
        fresh: whether its next actor begins as the configuration says, whatever it carried.
        failure: how it failed the last time; None: it has not.
        changing: the requests for a change that its actor has not answered yet.
        commands: those that wait until the one that is being carried out is done.
    """

    name: str
    spec: TaskSpec
    address: str
    life: Life
    mailbox: Mailbox = msgspec.field(default_factory=Mailbox)
    task: Reference | None = None
    carried: Carried | None = None
    rest: str = ""
    fresh: bool = False
    fence: Fence | None = None
    failure: Failure | None = None
    changing: tuple[Request, ...] = ()
    commands: tuple[Command, ...] = ()

    @property
    def how_it_is(self) -> str:
        """How it is in the word that people see in every list, as a clause: `a/client/Scan is stopped`."""
        if self.rest in ("", self.life.word):
            return f"{self.address} is {self.life.word}"
        return f"{self.address} does not run: {self.rest}"
