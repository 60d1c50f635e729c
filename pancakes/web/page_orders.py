"""What a page may ask for: a message from it becomes a control packet, or a sentence why not. Pure."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any, Final

import msgspec

from pancakes import codecs
from pancakes.control import Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.names import NAME

Name = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z")]
Target = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}/{NAME}\Z")]


class PageOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is common to all: the agent, the task on it (`service/task`), and whether it is only to be checked."""

    agent: Name
    task: Target
    dry_run: bool = False


class MoveOrder(PageOrder, frozen=True, tag_field="do", tag="migrate"):
    """To move a task to another agent."""

    to: Name

    def body(self) -> Migrate:
        """Returns the control packet's body."""
        return Migrate(self.task, self.to, dry_run=self.dry_run)


class RateOrder(PageOrder, frozen=True, tag_field="do", tag="rate"):
    """To change the rate of a task."""

    rate_hz: Annotated[float, msgspec.Meta(ge=0, le=1000)]

    def body(self) -> Reschedule:
        """Returns the control packet's body."""
        return Reschedule(self.task, self.rate_hz, dry_run=self.dry_run)


class StopOrder(PageOrder, frozen=True, tag_field="do", tag="stop"):
    """To stop a task."""

    def body(self) -> Stop:
        """Returns the control packet's body."""
        return Stop(self.task, dry_run=self.dry_run)


class StartOrder(PageOrder, frozen=True, tag_field="do", tag="start"):
    """To start a task."""

    def body(self) -> Start:
        """Returns the control packet's body."""
        return Start(self.task, dry_run=self.dry_run)


class RestartOrder(PageOrder, frozen=True, tag_field="do", tag="restart"):
    """To start a task anew, with its state."""

    def body(self) -> Restart:
        """Returns the control packet's body."""
        return Restart(self.task, dry_run=self.dry_run)


AnyOrder = MoveOrder | RateOrder | StopOrder | StartOrder | RestartOrder
_ORDER: Final[Callable[[Any], AnyOrder]] = codecs.converter(AnyOrder)


def order_from(message: Any) -> AnyOrder:
    """Makes an order of a message.

    Raises:
        ControlRefused: it is none; the sentence says what is wrong with it.
    """
    try:
        order: AnyOrder = _ORDER(message)
    except msgspec.ValidationError as error:
        raise ControlRefused(f"the page asked for what it cannot have: {_lower(str(error))}") from None
    return order


def _lower(text: str) -> str:
    return re.sub(r"^\w", lambda found: found[0].lower(), text)
