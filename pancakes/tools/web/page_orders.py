"""What a page may ask for: a message from it becomes a control packet, or a sentence why not. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.control import Configure, Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.names import NAME
from pancakes.runtime.kernel.handlers import period_of

MOST_SETTINGS: Final = 64
"""The most settings that one order may change."""
MOST_VALUES: Final = 1000
"""The most values in them, those in lists and tables counted."""
LONGEST_TEXT: Final = 4000
"""The most characters of one text in them."""
MOST_DEEP: Final = 8
"""The most lists and tables that may lie in each other."""
MOST_INTEGER: Final = 2**63 - 1

AgentName = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z")]
ServiceTask = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}/{NAME}\Z")]
"""A task on an agent, as `service/task`."""
Method = Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z_]\w{0,99}\Z")]


class PageOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a page may ask of an agent.

    Attributes:
        agent: the agent's name.
        task: the task on it, as `service/task`.
        do: what is to be done with the task.
        dry_run: whether the agent only checks it.
        to: the agent that the task moves to; of `migrate` alone.
        rate_hz: the task's new rate; of `rate` alone.
        timer: the method that ticks, where the task has several; of `rate` alone.
        settings: the new values by name, plain; of `configure` alone.
    """

    agent: AgentName
    task: ServiceTask
    do: Literal["migrate", "rate", "configure", "stop", "start", "restart"]
    dry_run: bool = False
    to: AgentName | None = None
    rate_hz: float | None = None
    timer: Method | None = None
    settings: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        for field, do, given in (
            ("to", "migrate", self.to),
            ("rate_hz", "rate", self.rate_hz),
            ("settings", "configure", self.settings),
        ):
            if (given is not None) != (self.do == do):
                raise ValueError(f"{field} goes with {do!r}, and with nothing else")
        if self.timer is not None and self.do != "rate":
            raise ValueError("timer goes with 'rate', and with nothing else")
        if self.rate_hz is not None:
            period_of(self.rate_hz)  # it says so of one that no agent takes
        if self.settings is not None and (fault := _fault_of(self.settings)):
            raise ValueError(fault)

    def body(self) -> Migrate | Reschedule | Configure | Stop | Start | Restart:
        """Returns the control packet's body."""
        if self.to is not None:
            return Migrate(self.task, self.to, dry_run=self.dry_run)
        if self.rate_hz is not None:
            return Reschedule(self.task, self.rate_hz, self.timer or "", self.dry_run)
        if self.settings is not None:
            return Configure(self.task, self.settings, self.dry_run)
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


def _fault_of(settings: Mapping[str, Any]) -> str:
    """Says why settings are more than a page may ask for; whether they are good the agent says. Empty: they are not."""
    if not settings:
        return "settings are empty"
    if len(settings) > MOST_SETTINGS:
        return f"{len(settings)} settings at once are too many, {MOST_SETTINGS} may be"
    for count, fault in enumerate(_faults(settings, 0)):
        if fault:
            return fault
        if count > MOST_VALUES:
            return f"settings of more than {MOST_VALUES} values are too many"
    return ""


def _faults(value: Any, depth: int) -> Iterator[str]:
    """Yields for each value in settings what is wrong with it; an empty text where nothing is."""
    if depth > MOST_DEEP:
        yield f"settings are nested more than {MOST_DEEP} deep"
    elif isinstance(value, Mapping):
        yield ""
        for key, item in value.items():
            yield _fault_of_text(key) if isinstance(key, str) else "a key of settings is no text"
            yield from _faults(item, depth + 1)
    elif isinstance(value, list):
        yield ""
        for item in value:
            yield from _faults(item, depth + 1)
    elif isinstance(value, str):
        yield _fault_of_text(value)
    elif isinstance(value, float):
        yield "" if math.isfinite(value) else "a number in settings is not finite"
    elif isinstance(value, int):
        yield "" if abs(value) <= MOST_INTEGER else "a number in settings is too large"
    else:
        yield "" if value is None else f"a value in settings is a {type(value).__name__}"


def _fault_of_text(text: str) -> str:
    return "" if len(text) <= LONGEST_TEXT else f"a text in settings has more than {LONGEST_TEXT} characters"
