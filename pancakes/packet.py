"""Packets: the only thing that tasks, services and agents say to each other (paper §3.1).

A packet has a channel, a type, a source and a destination. Its body is a frozen dataclass (or `msgspec.Struct`)
registered under the type's name, or a plain mapping if this process does not know the type.

Addresses read `agent/service/task`. A destination may be

* empty: all subscribers on this agent;
* `agent`, `agent/service` or `agent/service/task`: all subscribers there, under that address;
* `task:birthplace/name`: that task, on whatever agent it is now (see `task_address`);
* `*`: every neighbour (not this agent).

Source and number identify a packet for good: each life of an agent begins at another number.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar
from zlib import crc32

import msgspec

from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.util import codecs
from pancakes.util.arrays import as_list

_NUMBER_BITS: Final = 32
_LIFE_BITS: Final = 21
"""Together 53: more is not exact in JavaScript, nor in the JSON of many programs."""


def first_number(life: str) -> int:
    """Return the number of the first packet of each source in a life of an agent.

    Not of the boots that its journal has counted: these begin again after the disk was lost, and a disk that was
    restored counts some of them twice. That two of the lives of one agent begin alike has a chance of 1 in 2 million.

    Args:
        life: what was drawn for this life, see `Journal.life`.
    """
    return ((crc32(life.encode()) % (1 << _LIFE_BITS)) << _NUMBER_BITS) + 1


def number_in_life(seq: int) -> int:
    """Return the number of a packet among those of its source in one life of its agent, from 1: for people."""
    return seq & ((1 << _NUMBER_BITS) - 1)


class LocalTime(msgspec.Struct, frozen=True):
    """When something happened elsewhere, on one's own clock.

    Attributes:
        time_s: the moment, in one's own mission time, in seconds; negative: before one's own mission began.
        bound_s: the true moment lies no further from it, in mission seconds, while both clocks run evenly.
    """

    time_s: float
    bound_s: float


class Reader(Protocol):
    """A task or service that reads a packet."""

    def now(self) -> float:
        """Return the mission time of its agent, in seconds."""

    def local_time(self, packet: Any) -> LocalTime | None:
        """Return when a packet was published, on the clock of its agent; None: that is not known."""


class Turn:
    """The turn that a thread gives now, if it gives one.

    Attributes:
        reader: the task or service whose turn it is; None: the thread gives none.
        deferred: what the turn has put off to its end.
    """

    __slots__ = ("deferred", "reader")

    def __init__(self) -> None:
        self.reader: Reader | None = None
        self.deferred: list[Callable[[], None]] = []


class NewTypes:
    """The packet types that modules bring which are imported again; see `new_types`.

    Args:
        before: returns the names that a module had before it was imported again.

    Attributes:
        classes: the new classes, by the name of their type.
        replaced: the classes in use that differ from them, by the name of their type.
    """

    def __init__(self, before: Callable[[str], dict[str, Any]]) -> None:
        self.before = before
        self.classes: dict[str, type] = {}
        self.replaced: dict[str, type] = {}

    def gather(self, name: str, cls: type[_T]) -> type[_T]:
        """Take a class in; return it, or the one in use if that is the same."""
        known = _CLASSES.get(name)
        if known is not None:
            from pancakes.util.class_versions import differs  # few agents ever need it

            if not differs(known, cls, self.before(known.__module__)):
                return known
            self.replaced[name] = known
        self.classes[name] = cls
        _NAMES[cls] = name
        return cls

    def forget(self, module: str = "") -> None:
        """Leave the classes of a module as they are in use; empty: all."""
        for name in [name for name, cls in self.classes.items() if module in ("", cls.__module__)]:
            _NAMES.pop(self.classes.pop(name), None)
            self.replaced.pop(name, None)

    def install(self) -> None:
        """Give packets that come from now on bodies of the new classes. Any thread."""
        _CLASSES.update(self.classes)


class _Thread(threading.local):
    def __init__(self) -> None:
        self.turn = Turn()
        self.new_types: NewTypes | None = None


THREAD: Final = _Thread()
"""Has the `turn` of the thread that asks, and what gathers the packet types that it registers; None: they are used."""


SYSTEM: Final = "system"
"""Channel for sensor readings and other news about the system."""
SYSCTRL: Final = "sysctrl"
"""Channel for control: start, stop, restart, reschedule, migrate; and the replies."""
CTRL: Final = "ctrl"
"""Channel for commands to actuators."""
NETWORK: Final = "network"
"""Channel for what concerns, or is bound for, other agents."""
LOG: Final = "log"
"""Channel for events, errors and debug output."""

CORE_CHANNELS: Final = (SYSTEM, SYSCTRL, CTRL, NETWORK, LOG)

NEIGHBOURS: Final = "*"
"""The destination that means every neighbour."""

TO_TASK: Final = "task:"
"""What a destination begins with that means a task and not a place."""

Cause = tuple[str, int]
"""The (source, seq) of the packet that was being handled when another was published; in whatever life that was."""


class Fence(msgspec.Struct, frozen=True, array_like=True):
    """The right under which a task publishes, so that a copy that lost its right cannot move a wheel.

    Attributes:
        task_id: the task's durable identity, `birthplace/name`.
        epoch: how often it migrated, and the agent that minted that number; compared in this order.
        good_for_s: of a guarded task whose command goes to another agent: for how long it is good, in host seconds,
            counted from when it comes; None: as long as any.
    """

    task_id: str
    epoch: tuple[int, str]
    good_for_s: float | None = None


if TYPE_CHECKING:
    import typing_extensions

    Body_co = typing_extensions.TypeVar("Body_co", covariant=True, default=Any)
else:
    Body_co = TypeVar("Body_co", covariant=True)


class Packet(msgspec.Struct, Generic[Body_co], frozen=True, gc=False):
    """One message on the information stream: `Packet[Load]` has a body of the class `Load`.

    Attributes:
        channel: the channel it is published on, here or at its destination.
        type: the name of the type of its body.
        source: address of the publisher.
        destination: see the module's text.
        stamp_s: mission time at the publisher, in seconds.
        seq: number of this packet among its source's packets. Each life of an agent counts on from another place, so
            that source and number name one packet for good.
        body: a registered dataclass, or a plain mapping if the type is unknown here.
        cause: the packet that led to this one, if any.
        fence: set if a durable task published it.
    """

    channel: str
    type: str
    source: str
    destination: str
    stamp_s: float
    seq: int
    body: Body_co
    cause: Cause | None = None
    fence: Fence | None = None

    @property
    def number(self) -> int:
        """Its number among the packets of its source in this life of its agent, from 1: for people."""
        return number_in_life(self.seq)

    @property
    def age_s(self) -> float | None:
        """How long ago it was published, in mission seconds of the agent that reads it, never negative.

        `local_time` of the task that reads it has the moment and the bound of its error. None if that returns None,
        and outside of a turn of a task or service.
        """
        reader = THREAD.turn.reader
        published = reader.local_time(self) if reader is not None else None
        return max(0.0, reader.now() - published.time_s) if reader is not None and published is not None else None


_T = TypeVar("_T")
_CLASSES: dict[str, type] = {}
_NAMES: dict[type, str] = {}


def packet_type(name: str) -> Callable[[type[_T]], type[_T]]:
    """Register a frozen dataclass, or a frozen `msgspec.Struct`, as the body of packets of the type `name`.

    Raises:
        LocalProtocolError: another class has this name already, or the class is neither of these.
    """

    def register(cls: type[_T]) -> type[_T]:
        if not has_fields(cls):
            raise LocalProtocolError(f"the packet type {name!r} needs a dataclass, {cls.__qualname__} is none")
        known = _CLASSES.get(name)
        if known is not None and f"{known.__module__}.{known.__qualname__}" != f"{cls.__module__}.{cls.__qualname__}":
            raise LocalProtocolError(
                f"the packet type {name!r} is already {known.__module__}.{known.__qualname__},"
                f" so {cls.__module__}.{cls.__qualname__} needs another name"
            )
        if THREAD.new_types is not None:
            return THREAD.new_types.gather(name, cls)
        _CLASSES[name] = cls
        _NAMES[cls] = name
        return cls

    return register


@contextmanager
def new_types(before: Callable[[str], dict[str, Any]]) -> Iterator[NewTypes]:
    """Gather the packet types that this thread registers in the block; those in use stay as they are.

    A class that does not differ from the one in use gives way to it, so that it is one class for all that know it.

    Args:
        before: returns the names that a module had before it was imported again.
    """
    gathered = THREAD.new_types = NewTypes(before)
    try:
        yield gathered
    except BaseException:
        gathered.forget()
        raise
    finally:
        THREAD.new_types = None


def has_fields(cls: type) -> bool:
    """Return whether a class may be the body of a packet: a dataclass, or a `msgspec.Struct` that travels as a map."""
    if is_dataclass(cls):
        return True
    if not (isinstance(cls, type) and issubclass(cls, msgspec.Struct)):
        return False
    config = cls.__struct_config__
    return not config.array_like and config.tag is None and cls.__struct_encode_fields__ == cls.__struct_fields__


def field_names(cls: type) -> tuple[str, ...]:
    """Return the names of the fields of a body's class, in order."""
    if is_dataclass(cls):
        return tuple(field.name for field in fields(cls))
    return cls.__struct_fields__ if issubclass(cls, msgspec.Struct) else ()


def type_name(body: Any) -> str:
    """Return the type name of a body, or of a body's class.

    Raises:
        LocalProtocolError: its class was never registered with `packet_type`.
    """
    name = _NAMES.get(type(body))
    if name is None:
        cls = body if isinstance(body, type) else type(body)
        name = _NAMES.get(cls)
        if name is None:
            raise LocalProtocolError(
                f"{cls.__module__}.{cls.__qualname__} is no packet type: decorate it with @packet_type"
            )
    return name


def type_of(body: Any) -> str:
    """Return the type name of the body of a packet that is made.

    Raises:
        LocalProtocolError: its class was never registered with `packet_type`, or it is a class itself.
    """
    name = _NAMES.get(type(body))
    if name is None:
        if isinstance(body, type):
            raise LocalProtocolError(f"{body.__qualname__} is a class: publish an instance, {body.__qualname__}(...)")
        return type_name(body)
    return name


def is_of_type(body: Any, name: str) -> bool:
    """Return whether a body is an instance of a class that is registered under `name`."""
    return _NAMES.get(type(body)) == name


def body_class(name: str) -> type | None:
    """Return the class registered under `name`, or None."""
    return _CLASSES.get(name)


def known_types() -> dict[str, type]:
    """Return all registered packet types by name, sorted."""
    return dict(sorted(_CLASSES.items()))


def body_from_plain(name: str, plain: Any) -> Any:
    """Make the body of a packet of the type `name` from plain values, checking each of them.

    Returns:
        An instance of the registered class; `plain` itself if the type is unknown here.

    Raises:
        RemoteProtocolError: the values do not fit the class.
    """
    cls = _CLASSES.get(name)
    if cls is None:
        return plain
    try:
        return codecs.convert(plain, cls)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"a packet of the type {name!r} has a bad body: {error}") from None


def body_to_plain(body: Any) -> Any:
    """Return a body, or a part of one, as mappings, lists (or tuples), strings and numbers; arrays become lists.

    Raises:
        TypeError: it contains what no packet may contain.
    """
    return msgspec.to_builtins(body, enc_hook=as_list, str_keys=True)


def join(agent: str, service: str = "", task: str = "") -> str:
    """Return the address of an agent, one of its services, or a task."""
    return "/".join(part for part in (agent, service, task) if part)


def task_address(task_id: str) -> str:
    """Return the destination that means a task, wherever it is.

    Such a packet is kept by its sender until the task has handled it: it waits while the task moves, and takes effect
    once, in the order in which this agent's packets to the task were published.

    Args:
        task_id: the task's identity for life, `birthplace/name`: the agent that it was born on, and its name there.
    """
    return TO_TASK + task_id


def agent_of(address: str) -> str:
    """Return the agent's part of an address."""
    return address.partition("/")[0]


def covers(destination: str, address: str) -> bool:
    """Return whether a destination on this agent means the component at `address`."""
    return address == destination or address.startswith(destination + "/")
