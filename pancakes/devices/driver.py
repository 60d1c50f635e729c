"""Write a driver: the base classes `Driver`, `Sensor` and `Actuator` (paper §3.3; docs/writing-a-driver.md).

The Device Service makes one driver for each `[device.NAME]`. The device's task owns it and calls all of its methods in
its actor, one at a time. A driver that must wait for its hardware sets `blocking = True`; its task then gets a thread.
`Hardware` names what a driver opens of its computer. `Pace` limits the rate of readings.
"""

from __future__ import annotations

import errno
import os
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, Protocol, TypeVar, get_args

import msgspec

from pancakes.errors import ClassError
from pancakes.events import Log, check_levels
from pancakes.mesh.transport import Transport
from pancakes.packet import Packet
from pancakes.supervision.serializable_types import check_saved
from pancakes.util.class_checks import Made, check_made, check_marks, check_overrides, check_own_names, place_of_field


class Hardware(msgspec.Struct, frozen=True):
    """A device of the operating system.

    Attributes:
        node: its file below `/dev`, such as `/dev/ttyUSB0`, or a class of them, such as `char-i2c`.
        group: the group of the machine whose members may open it, such as `dialout`; empty: no group is needed.
    """

    node: str
    group: str = ""


def why_not_opened(error: OSError) -> str:
    """Return why a node could not be opened, with what to do where the computer forbids it."""
    if error.errno is None:
        return str(error)
    reason = os.strerror(error.errno)
    if error.errno == errno.EPERM:
        return f"{reason}: a service opens the nodes that its unit names, print the unit again and restart it"
    if error.errno == errno.EACCES:
        return f"{reason}: the agent's user has to be in the group of that node"
    return reason


_EARLY = 0.25


class Pace:
    """Limit a stream to a rate, evenly.

    A thing that is a quarter of a period early counts as being in time, so that a source of the same rate that is not
    quite regular does not lose every other one; in the long run the rate is kept all the same.

    Args:
        rate_hz: how many a second may pass.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._next_s = 0.0

    def due(self, time_s: float) -> bool:
        """Something comes at `time_s`; returns whether it may pass."""
        if time_s < self._next_s - _EARLY * self._period_s:
            return False
        # A gap is not made up for afterwards.
        next_s, gap_s = self._next_s + self._period_s, time_s + (1.0 - _EARLY) * self._period_s
        self._next_s = next_s if next_s > gap_s else gap_s
        return True


_T = TypeVar("_T")
Rate = Literal["needed", "optional", "none"]
_HOOKS: Final = ("type", "blocking", "networked", "rate", "Settings", "hardware", "open", "close", "receive")


class DeviceContext(Protocol):
    """What a driver may ask of the agent that it serves.

    Attributes:
        agent: the agent's name.
        device: the device's name, as in `[device.NAME]`.
        random: a source of random numbers, seeded from the agent's seed and the device's address.
        transport: how this agent reaches others; for drivers whose hardware is at the end of a connection.
        virtual: whether it runs in virtual time, where hardware of the real world cannot be spoken to.
    """

    agent: str
    device: str
    random: random.Random
    transport: Transport
    virtual: bool

    def now(self) -> float:
        """Return the mission time in seconds."""
        ...

    def deliver(self, body: Any) -> None:
        """Publish a reading of this device on `system`. May be called from any thread.

        One with a number that is not finite, or that its field does not allow, is missed instead.
        """
        ...

    def missed(self, why: str) -> None:
        """Count a reading that failed, and tell the log how many did. May be called from any thread.

        A driver that is sampled raises an error instead.

        Args:
            why: why there is none, as a sentence.
        """
        ...

    def alive(self) -> None:
        """The hardware has said something that is no reading: it is not silent. May be called from any thread."""
        ...

    def send(self, channel: str, body: Any, to: str) -> None:
        """Publish a packet to a destination, in the device's name; for devices that live elsewhere."""
        ...

    def call(self, function: Callable[[], None]) -> None:
        """Run `function` in the device's actor, after what it is doing now. May be called from any thread."""
        ...

    def after(self, delay_s: float, function: Callable[[], None]) -> None:
        """Run `function` in the device's actor in `delay_s` seconds of mission time."""
        ...

    @property
    def log(self) -> Log:
        """Publishes lines on `log`, behind the device's name: `self.context.log.warning("no echo")`. Any thread."""
        ...

    def mission_packets_sent(self) -> int:
        """Return how many mission packets this agent has sent to others so far (heartbeats do not count)."""
        ...

    def network_awake(self) -> bool:
        """Return whether the Network Service is awake, so that this agent hears others."""
        ...

    def shared(self, key: str, make: Callable[[], _T]) -> _T:
        """Return what this agent's drivers share under `key`, making it at the first call.

        It is closed (by its `close()`) when the agent stops.
        """
        ...


@dataclass
class NoSettings:
    """The settings of a driver without settings."""


_Class = type
"""A driver's own attribute is called `type`."""


class Driver(ABC):
    """The base of all drivers.

    Attributes:
        type: the type of the device, which is also the type of its packets (`pose`, `motors`, ...).
        blocking: whether its methods may wait for the hardware.
        networked: whether its readings come from another agent; then the network may not sleep while a task needs them.
        rate: what it does with the device's `rate_hz`. `needed`: without a rate it never does anything, so a
            configuration without one is refused. `optional`: it works with and without one. `none`: it acts when its
            hardware does, and a configuration with a rate is refused.
        settings: an instance of the class's `Settings`, from `[device.NAME] settings`.
        Settings: the dataclass of its settings; a driver with settings has its own.
    """

    type: ClassVar[str]
    blocking: ClassVar[bool] = False
    networked: ClassVar[bool] = False
    rate: ClassVar[Rate] = "optional"
    _made_as: ClassVar[Made] = Made(("context", "settings"), "a driver", "`def open(self)`")

    context: DeviceContext
    settings: Any
    Settings: ClassVar[_Class] = NoSettings

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work: a method that Pancakes calls, or `Settings`."""
        check_own_names(cls, Driver, _HOOKS)
        super().__init_subclass__(**others)
        check_overrides(cls)
        check_marks(cls, "a driver")
        check_levels(cls)
        check_made(cls)
        check_saved(cls, "Settings")
        if cls.rate not in get_args(Rate):
            known = ", ".join(map(repr, get_args(Rate)))
            raise ClassError(f"{place_of_field(cls)}: {cls.__qualname__}.rate is {cls.rate!r}, and none of {known}")

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        self.context = context
        self.settings = settings

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        """Return what a device with these settings opens of its computer, for the unit of a service of the system.

        Args:
            settings: the driver's settings.
        """
        return ()

    def open(self) -> None:
        """Prepare the hardware. An error here fails the device, which its service then restarts."""

    def close(self) -> None:
        """Let go of the hardware. Called once, also after a failed `open`."""

    def receive(self, packet: Packet) -> None:
        """Take a packet that was addressed to this device (a virtual device's way in)."""


class Sensor(Driver):
    """A driver that brings readings: by `read`, at the device's rate, unless its class says otherwise in `rate`."""

    rate: ClassVar[Rate] = "needed"
    silent_s: ClassVar[float | None] = None
    """Without a reading for this long, in mission seconds, it is silent; `silent_mission_s` overrides it."""

    @abstractmethod
    def read(self) -> Any | None:
        """Return a reading, at each tick of the device's rate.

        Returns:
            The body of a packet of the driver's type. None if the reading comes later, by `context.deliver`, or if
            there is no reading now.

        Raises:
            Exception: the reading failed. It is missed and counted; too many of them fail the device.
        """

    def silent(self) -> None:
        """Called each `silent_s` in which no reading has come; for a driver whose connection may be dead."""


class Actuator(Driver):
    """A driver that carries commands out."""

    @abstractmethod
    def write(self, command: Any, ttl_s: float, source: str) -> None:
        """Carry a command out.

        Args:
            command: the body of a packet of the driver's type.
            ttl_s: for how long it is good, in mission seconds: the device's `hold_after_mission_s`, or less where the
                right of a guarded task ends sooner. The hardware should go to its safe hold when no other command comes
                in that time, even if this process is gone; see `watchdog_s`.
            source: address of the task that gave it.
        """

    def watchdog_s(self, hold_after_s: float) -> float | None:
        """Return after how long the hardware holds by itself where no process tells it to: its dead-man switch.

        Called once the driver is open. Without one, a guarded task that commands the device is warned of.

        Args:
            hold_after_s: the longest time to live of a command, in mission seconds.

        Returns:
            The time without a fresh command, in mission seconds: `hold_after_mission_s` of hardware that counts each
            command's time to live, the time-out of hardware that has one of its own. None: it keeps its last command.
        """
        return None

    @abstractmethod
    def safe_stop(self) -> None:
        """Go to the safe hold: the state that is harmless and needs no attention (wheels: stopped)."""

    def tick(self) -> None:
        """Called at the device's rate, if it has one."""
