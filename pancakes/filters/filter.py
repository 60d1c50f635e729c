"""Write a filter: the base class `Filter`, and what it may return (docs/filters.md).

The actuator's device makes one instance for each `[filter.NAME]`. All of its methods run in the device's actor, one at
a time, so a filter must not wait: the command waits with it. It stays the same instance when the driver is opened again
with other settings. If the device is restarted, because it has failed, a new instance finds in `context.kept` what the
former one has kept there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Final, Protocol

import msgspec

from pancakes.devices.driver import NoSettings
from pancakes.events import Log, check_levels
from pancakes.packet import Packet
from pancakes.supervision.serializable_types import check_saved
from pancakes.util.class_checks import Made, check_made, check_marks, check_overrides, check_own_names

_HOOKS: Final = ("type", "Settings", "check_hz", "open", "close", "apply", "on_settings", "on_hold")


class Changed(msgspec.Struct, frozen=True):
    """A filter's answer: carry out another command.

    Attributes:
        command: the command to carry out, a body of the actuator's type.
        why: why it is another one, as a clause without numbers that change all the time: `keeps clear of agent2`.
    """

    command: Any
    why: str


class Held(msgspec.Struct, frozen=True):
    """A filter's answer: the actuator goes to its safe hold, and stays there until a command passes.

    Attributes:
        why: why, as a clause: `its own pose is too old`.
    """

    why: str


class FilterContext(Protocol):
    """What a filter may ask of the agent that it serves.

    Attributes:
        agent: the agent's name.
        device: the name of the actuator, as in `[device.NAME]`.
        name: the filter's own name, as in `[filter.NAME]`.
        kept: the filter's own notes, which outlive a restart of its device, until the device service or the agent ends.
    """

    agent: str
    device: str
    name: str
    kept: dict[str, Any]

    def now(self) -> float:
        """Return the mission time in seconds. Any thread."""
        ...

    def subscribe(self, channel: str, body: type, handler: Callable[[Packet], None]) -> None:
        """Call `handler`, in the device's actor, with each packet of a type on a channel from now on."""
        ...

    def publish(self, channel: str, body: Any, to: str = "") -> None:
        """Publish a packet in the device's name. One that cannot leave is lost, and counted with those of the agent."""
        ...

    def after(self, delay_s: float, function: Callable[[], None]) -> None:
        """Call `function` in the device's actor in `delay_s` seconds of mission time."""
        ...

    def published_s(self, packet: Packet) -> float:
        """Return when a packet was published at the latest, on this agent's mission clock.

        For a packet of another agent that is as well known as the clocks of the two are (docs/time.md). If nothing is
        known of them yet, it is the moment at which the packet is handled.
        """
        ...

    @property
    def log(self) -> Log:
        """Publishes lines on `log`, behind the names of the device and the filter."""
        ...


class Filter(ABC):
    """The base of all filters.

    Attributes:
        type: the type of the actuators that it is for (`motors`, ...); empty: of all.
        context: what it may ask of its agent.
        settings: an instance of the class's `Settings`, from `[filter.NAME] settings`; replaced when they change.
        Settings: the dataclass of its settings; a filter with settings has its own.
    """

    type: ClassVar[str] = ""
    _made_as: ClassVar[Made] = Made(("context", "settings"), "a filter", "`def open(self)`")

    context: FilterContext
    settings: Any
    Settings: ClassVar[Any] = NoSettings

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work: a method that Pancakes calls, or `Settings`."""
        check_own_names(cls, Filter, _HOOKS)
        super().__init_subclass__(**others)
        check_overrides(cls)
        check_marks(cls, "a filter")
        check_levels(cls)
        check_made(cls)
        check_saved(cls, "Settings")

    def __init__(self, context: FilterContext, settings: Any) -> None:
        self.context = context
        self.settings = settings

    @property
    def check_hz(self) -> float:
        """How often the newest command passes again while it is good, for each second of mission time.

        So a filter reacts to what has changed since the command came. 0: it passes only when it comes.
        """
        return 0.0

    def open(self) -> None:
        """Begin; subscribe to what the filter needs to know. An error here fails the device."""

    def close(self) -> None:
        """End with the device. Called once, also after a failed `open`."""

    def on_settings(self) -> None:
        """Called when `settings` were replaced. A `ValueError` or `PancakesError` refuses them."""

    def on_hold(self) -> None:
        """Called when the actuator goes to its safe hold, whatever the reason: no command is carried out now."""

    @abstractmethod
    def apply(self, command: Any, ttl_s: float, source: str) -> Any:
        """Return what may be carried out in place of a command.

        An error lets nothing pass: the actuator goes to its safe hold, and the error is logged.

        Args:
            command: the body of a packet of the actuator's type; its numbers are finite.
            ttl_s: for how long it is good, in mission seconds.
            source: the address of the task that gave it.

        Returns:
            The same command: it passes. `Changed`: another one passes. `Held`: none does.
        """
