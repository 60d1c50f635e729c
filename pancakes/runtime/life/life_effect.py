"""What a life asks its keeper for. Effects are carried out in the order listed."""

from __future__ import annotations

from enum import Enum

import msgspec

from pancakes.runtime.life.request import Request
from pancakes.runtime.life.restart import Next


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
    """It has come to rest: write down what is wanted of it, where that is to outlive a crash; then feed `Written`."""


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
