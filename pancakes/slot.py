"""The place of one task in its service, and what the service knows about it."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

import msgspec

from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import Cause, Fence
from pancakes.supervision import Supervision
from pancakes.task import Carried, Task, TaskSpec


class TaskState(Enum):
    """What a task does now, as its service sees it."""

    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    STUCK = "stuck"
    """It was asked to stop and does not come back from what it is doing. Python cannot end its thread."""
    RESTARTING = "restarting"
    FAILED = "failed"
    """It failed too often, and its service gave up on it."""


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


class Request(msgspec.Struct, frozen=True):
    """Who asked for something, and which packet of theirs it was.

    Attributes:
        by: the asker's address.
        cause: the packet.
        number: its place in the order of all commands to this agent.
    """

    by: str
    cause: Cause
    number: int = 0


class Slot(msgspec.Struct):
    """The place of one task in its service: it outlives the actors that fill it.

    Who waits for something stands in tuples: empty ones cost nothing, and empty lists and a deque for each of ten
    thousand tasks are 11 MiB.

    Attributes:
        failure: how it failed the last time; None: it has not.
        carried: what its next actor begins with; None: what the configuration says.
        on_running: told when its task runs, or with the reason why it does not.
        on_ended: told when its task has ended.
        on_stuck: told when its task does not end.
        on_lost: told when its task ends before it has done what it was asked.
        busy: whether a command that starts or stops the task is being carried out.
        commands: those that wait for that.
    """

    spec: TaskSpec
    address: str
    supervision: Supervision
    mailbox: Mailbox = msgspec.field(default_factory=Mailbox)
    state: TaskState = TaskState.STOPPED
    task: Task | None = None
    carried: Carried | None = None
    fence: Fence | None = None
    incarnation: int = 0
    reason: str = ""
    failure: Failure | None = None
    on_running: tuple[Callable[[str], None], ...] = ()
    on_ended: tuple[Callable[[], None], ...] = ()
    on_stuck: tuple[Callable[[str], None], ...] = ()
    on_lost: tuple[Callable[[str], None], ...] = ()
    busy: bool = False
    commands: tuple[Callable[[], None], ...] = ()

    @property
    def name(self) -> str:
        """The task's name."""
        return self.spec.name
