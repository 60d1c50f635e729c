"""What a page may ask for: a message from it becomes a control packet, or a sentence why not. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.control import Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.names import NAME

Name = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z")]
Target = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}/{NAME}\Z")]


class PageOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a page may ask of an agent.

    Attributes:
        agent: the agent's name.
        task: the task on it, as `service/task`.
        do: what is to be done with the task.
        dry_run: whether the agent only checks it.
        to: the agent that the task moves to; of `migrate` alone.
        rate_hz: the task's new rate; of `rate` alone.
    """

    agent: Name
    task: Target
    do: Literal["migrate", "rate", "stop", "start", "restart"]
    dry_run: bool = False
    to: Name | None = None
    rate_hz: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None

    def __post_init__(self) -> None:
        for field, do, given in (("to", "migrate", self.to), ("rate_hz", "rate", self.rate_hz)):
            if (given is not None) != (self.do == do):
                raise ValueError(f"{field} goes with {do!r}, and with nothing else")

    def body(self) -> Migrate | Reschedule | Stop | Start | Restart:
        """Returns the control packet's body."""
        if self.to is not None:
            return Migrate(self.task, self.to, dry_run=self.dry_run)
        if self.rate_hz is not None:
            return Reschedule(self.task, self.rate_hz, dry_run=self.dry_run)
        return _PLAIN[self.do](self.task, dry_run=self.dry_run)


_PLAIN: Final[Mapping[str, type[Stop] | type[Start] | type[Restart]]] = {
    "stop": Stop,
    "start": Start,
    "restart": Restart,
}


def order_from(message: Any) -> PageOrder:
    """Makes an order of a message.

    Raises:
        ControlRefused: it is none; the sentence says what is wrong with it.
    """
    try:
        return codecs.convert(message, PageOrder)
    except msgspec.ValidationError as error:
        raise ControlRefused(f"the page asked for what it cannot have: {_lower(str(error))}") from None


def _lower(text: str) -> str:
    return re.sub(r"^\w", lambda found: found[0].lower(), text)
