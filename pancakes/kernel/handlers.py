"""Declare what a component reacts to: `@on` a packet, `@every` period, and how many packets may wait (paper §3.2).

A handler takes what its parameters say: a packet, a body, or both.

    @on(SYSTEM, Load)
    def measured(self, packet: Packet[Load]) -> None: ...

    @on(SYSTEM)
    def measured(self, load: Load) -> None: ...

    @on(SYSTEM)
    def measured(self, load: Load, packet: Packet[Load]) -> None: ...

`plan_of` reads the marks of a class once and keeps the result, because thousands of actors share one class. A queue
policy (`QueuePolicy`) bounds what waits for a slow reader in packets and in bytes: `latest`, a number, or
`reliable(n)`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from enum import Enum
from functools import lru_cache, partial
from numbers import Real
from types import FrameType, FunctionType, SimpleNamespace
from typing import (
    Any,
    Final,
    Literal,
    NamedTuple,
    Never,
    Protocol,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import msgspec

from pancakes.errors import ClassError, LocalProtocolError
from pancakes.packet import Packet, covers, type_name
from pancakes.util.class_checks import (
    ANSWERS,
    GIVEN,
    PERIOD,
    SUBSCRIPTIONS,
    check_called,
    is_async,
    place_of_function,
    takes,
)

MOST_BYTES: Final = 16 * 1024 * 1024
"""The most bytes of bodies that wait under a subscription. One may always wait; light bodies do not count."""


class QueuePolicy(msgspec.Struct, frozen=True):
    """What a subscription does when its reader is slow, or the bodies that wait take more than `MOST_BYTES`.

    Attributes:
        limit: how many packets wait at the most.
        reliable: whether a packet that finds no room is refused to its publisher; else the oldest falls
            out and is counted.
        urgent: whether the packets go before all others, also while the reader awaits or is paused; one that finds
            no room is dropped and counted. Not for authors: their handlers run one at a time, in order.
    """

    limit: int
    reliable: bool = False
    urgent: bool = False

    def __str__(self) -> str:
        """Return it as an author writes it after `queue=`: `latest`, `100`, `reliable(100)`."""
        if self.reliable:
            return f"reliable({self.limit})"
        return str(self.limit) if self.limit > 1 else "latest"

    @property
    def counts_losses(self) -> bool:
        """Whether a packet that falls out is lost: not if only the newest is wanted."""
        return self.reliable or self.limit > 1

    def is_full(self, waiting: int, waiting_bytes: int, weight: int) -> bool:
        """Return whether one more packet finds no room.

        Args:
            waiting: how many packets wait.
            waiting_bytes: the bytes of the heavy ones among them.
            weight: the bytes of the packet; 0 for a light one.
        """
        return waiting >= self.limit or (waiting > 0 and weight > 0 and waiting_bytes + weight > MOST_BYTES)


LATEST = QueuePolicy(1)
"""Only the newest packet waits."""


def drop_oldest(limit: int) -> QueuePolicy:
    """Up to `limit` packets wait; then the oldest falls out, and is counted.

    Raises:
        ClassError: the limit is no whole number of at least 1.
    """
    return QueuePolicy(_checked(limit))


def reliable(limit: int) -> QueuePolicy:
    """Up to `limit` packets wait; then publishing raises `MailboxFullError`, and no subscriber gets the packet.

    Raises:
        ClassError: the limit is no whole number of at least 1.
    """
    return QueuePolicy(_checked(limit), reliable=True)


Queue = QueuePolicy | int | Literal["latest"]
"""How an author writes a queue policy: `"latest"`, how many packets wait before the oldest falls out, `reliable(n)`."""


def queue_policy(queue: Queue) -> QueuePolicy:
    """Return what a subscription does, as its author has written it.

    Raises:
        ClassError: it is none of these; with it, each publisher would fail later.
    """
    if isinstance(queue, QueuePolicy):
        return queue
    if queue == "latest":
        return LATEST
    if isinstance(queue, int) and not isinstance(queue, bool):
        return drop_oldest(queue)
    raise ClassError(f'queue is {queue!r}: write queue="latest", queue=100 or queue=reliable(100)')


def _checked(limit: int) -> int:
    if type(limit) is not int or limit < 1:
        raise ClassError(f"a queue takes how many packets wait at most, a whole number from 1, and not {limit!r}")
    return limit


_F = TypeVar("_F", bound=Callable[..., Any])

DEFAULT_QUEUE = drop_oldest(256)
MOST_HZ = 10_000.0
"""No timer ticks faster: one that did would leave its agent time for nothing else."""


class Tick(msgspec.Struct, frozen=True, gc=False):
    """What a time-driven method is given.

    Attributes:
        time_s: the deadline of this tick, in mission time.
        missed: how many ticks before it never came, because the component was late.
        lateness_s: how long after its deadline the method was called, in mission time.
    """

    time_s: float
    missed: int = 0
    lateness_s: float = 0.0


class Subscription(msgspec.Struct, frozen=True):
    """What a method listens to.

    Attributes:
        channel: the channel.
        type: the name of the packets' type; None: all types.
        queue: what happens when the component is slow.
        addressed: only packets whose destination is this component.
    """

    channel: str
    type: str | None
    queue: QueuePolicy
    addressed: bool = False


class Period(msgspec.Struct, frozen=True):
    """How often a method is called, in seconds of mission time; infinity: not before it is rescheduled."""

    period_s: float


class Given(Enum):
    """What a handler is called with."""

    PACKET = "packet"
    BODY = "body"
    BODY_AND_PACKET = "body and packet"


_Body = TypeVar("_Body")
_Body_co = TypeVar("_Body_co", covariant=True)
_Self = TypeVar("_Self")
_Result = TypeVar("_Result")


class _TakesBody(Protocol[_Body_co]):
    """Decorates a handler of packets with bodies of one class, for type checkers.

    The result takes any body, so that a second `@on` with another class may stand above the first.
    """

    @overload
    def __call__(
        self, method: Callable[[_Self, Packet[_Body_co]], _Result], /
    ) -> Callable[[_Self, Packet[Any]], _Result]: ...

    @overload
    def __call__(self, method: Callable[[_Self, _Body_co], _Result], /) -> Callable[[_Self, Any], _Result]: ...

    @overload
    def __call__(
        self, method: Callable[[_Self, _Body_co, Packet[_Body_co]], _Result], /
    ) -> Callable[[_Self, Any, Packet[Any]], _Result]: ...

    def __call__(self, method: Callable[..., Any], /) -> Callable[..., Any]: ...


@overload
def on(
    channel: str,
    body: type[_Body],
    *,
    queue: Queue = DEFAULT_QUEUE,
    addressed: bool = False,
) -> _TakesBody[_Body]: ...


@overload
def on(
    channel: str,
    body: str | None = None,
    *,
    queue: Queue = DEFAULT_QUEUE,
    addressed: bool = False,
) -> Callable[[_F], _F]: ...


def on(
    channel: str,
    body: type | str | None = None,
    *,
    queue: Queue = DEFAULT_QUEUE,
    addressed: bool = False,
) -> Any:
    """Make a method event-driven: it is called with each packet on `channel`, in the component's actor.

    It is called with the packet, with the body, or with the body and the packet, as its parameters say. A task's may be
    `async def`: see `pancakes.kernel.awaiting`.

    Args:
        channel: the channel to listen to.
        body: the class of the packets' bodies, or their type's name; None: the class that the method's annotation
            names, or packets of all types if it names none.
        queue: what waits when the component is slow: `"latest"`, how many packets before the oldest falls out, or
            `reliable(n)`.
        addressed: only packets whose destination is this component.

    Raises:
        ClassError: the method cannot be called with a packet, or its annotation names no packet type; it has an
            `@every`, or listens to such packets already; or `queue` is nothing of that kind.
    """
    if not isinstance(channel, str):
        raise ClassError(f'@on takes the name of a channel, not {channel!r}: write @on("system")')
    name = body if body is None or isinstance(body, str) else type_name(body)
    policy = queue_policy(queue)

    def mark(method: _F) -> _F:
        check_given(method)
        given, of_annotation = _given_to(method, body, sys._getframe(1))  # noqa: SLF001
        subscribed = of_annotation if name is None else name
        subscription = Subscription(channel, subscribed, policy, addressed)
        before = getattr(method, SUBSCRIPTIONS, ())
        if hasattr(method, PERIOD):
            raise _both(method)
        if any(it.channel == channel and (it.type == subscribed or None in (it.type, subscribed)) for it in before):
            raise ClassError(
                f"{_head(method)} is decorated twice with @on({channel!r}) for the same packets, with each of which it"
                " would be called twice: leave one of them out"
            )
        setattr(method, SUBSCRIPTIONS, (*before, subscription))
        setattr(method, GIVEN, given)
        return method

    return mark


def check_given(method: Any) -> None:
    """Refuse a method that cannot be called with a packet, nor with its body and the packet.

    Raises:
        ClassError: names its file and line.
    """
    given: tuple[str, ...] = ("self", "packet")
    if isinstance(method, FunctionType) and not takes(method, 2) and takes(method, 3):
        given = ("self", "body", "packet")
    wanted = f"def {_name_of(method)}(self, packet: Packet) -> None"
    check_called(method, given, "@on calls it with a packet", wanted, may_await=True)


_PACKET_NAMES: Final = ("Packet", "Any", "object")


def _given_to(method: Callable[..., Any], body: type | str | None, around: FrameType) -> tuple[Given, str | None]:
    """Return what a handler is called with, and the packet type that its annotation names, if one is wanted.

    Args:
        method: the handler.
        body: what its decorator says of the type.
        around: the frame in which it is written.
    """
    both = not takes(method, 2)
    parameter = _first_parameter(method)
    annotation = parameter.annotation if parameter is not None else inspect.Parameter.empty
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", repr(annotation))
    head, bracket, _ = text.partition("[")
    is_packet = head.strip().rpartition(".")[2] in _PACKET_NAMES or get_origin(annotation) is Packet
    if not both and (parameter is None or annotation is inspect.Parameter.empty or is_packet):
        inside = bracket or get_args(annotation)
        if body is None and inside:
            return Given.PACKET, _type_of_annotation(method, annotation, around, "Packet")
        return Given.PACKET, None
    given = Given.BODY_AND_PACKET if both else Given.BODY
    if body is not None:
        return given, None
    if annotation is inspect.Parameter.empty:
        raise ClassError(
            f"{_head(method)} takes a body and a packet, and nothing says of which type: write its class into @on, as"
            ' in @on("system", Load), or at the parameter, as in `load: Load`'
        )
    return given, _type_of_annotation(method, annotation, around, "")


def _first_parameter(method: Callable[..., Any]) -> inspect.Parameter | None:
    """Return the parameter behind `self`; None: there is none by itself, as in `*args`."""
    code = getattr(method, "__code__", None)
    if code is not None and code.co_argcount >= 2:  # a signature takes 10 µs
        name = code.co_varnames[1]
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        return inspect.Parameter(name, kind, annotation=method.__annotations__.get(name, inspect.Parameter.empty))
    try:
        parameters = list(inspect.signature(method).parameters.values())
    except (TypeError, ValueError):
        return None
    named = [it for it in parameters[1:2] if it.kind in (it.POSITIONAL_ONLY, it.POSITIONAL_OR_KEYWORD)]
    return named[0] if named else None


def _type_of_annotation(method: Callable[..., Any], annotation: Any, around: FrameType, within: str) -> str:
    """Return the name of the packet type that an annotation names.

    Args:
        method: the handler.
        annotation: of its parameter; text if annotations are not evaluated in its module.
        around: the frame in which it is written.
        within: `Packet`, if the class stands in brackets behind that.
    """
    written = annotation if isinstance(annotation, str) else getattr(annotation, "__qualname__", repr(annotation))
    try:
        if isinstance(annotation, str):
            text = annotation.partition("[")[2].rpartition("]")[0] if within else annotation
            alone = SimpleNamespace(__annotations__={"body": text})  # the others need not be known when it is read
            cls = get_type_hints(alone, getattr(method, "__globals__", {}), _names_around(around))["body"]
        else:
            cls = get_args(annotation)[0] if within else annotation
        return type_name(cls)
    except (NameError, AttributeError, SyntaxError, TypeError, LocalProtocolError):
        raise ClassError(
            f"{_head(method)} takes {written!r}, which names no packet type: decorate its class with @packet_type, or"
            ' write the type into @on, as in @on("system", Load)'
        ) from None


def _names_around(frame: FrameType) -> dict[str, Any]:
    """Return the names that are known where a class is written: those of its body, and of a function around it."""
    outer = frame.f_back.f_locals if frame.f_back is not None else {}
    return {**outer, **frame.f_locals}


def every(*bare: Never, hz: float | None = None, period_s: float | None = None) -> Callable[[_F], _F]:
    """Make a method time-driven: it is called with a `Tick` at a rate that can be changed while it runs.

    Args:
        bare: nothing: a number without a name could be a rate or a period.
        hz: ticks for each second of mission time; 0: none before it is rescheduled.
        period_s: instead, seconds of mission time from tick to tick.

    A task's method may be `async def`: ticks that come while it is awaited count as missed, but for the last.

    Raises:
        ClassError: neither a rate nor a period is given, or both, or one that no timer can have; or the method cannot
            be called with a `Tick`; or it has an `@on` or another `@every`.
    """
    period = _period(bare, hz, period_s)

    def mark(method: _F) -> _F:
        wanted = f"def {_name_of(method)}(self, tick: Tick) -> None"
        check_called(method, ("self", "tick"), "@every calls it with a Tick", wanted, may_await=True)
        if hasattr(method, PERIOD):
            raise ClassError(
                f"{_head(method)} is decorated twice with @every, and a method has one rate: leave one of them out, or"
                " write a second method"
            )
        if hasattr(method, SUBSCRIPTIONS):
            raise _both(method)
        setattr(method, PERIOD, period)
        return method

    return mark


def _period(bare: tuple[Any, ...], hz: float | None, period_s: float | None) -> Period:
    if bare and not isinstance(bare[0], Real):
        raise ClassError(f"@every takes a rate or a period, not {bare[0]!r}: write @every(hz=10)")
    if bare:
        ways = f"@every(hz={bare[0]:g}) for a rate, @every(period_s={bare[0]:g}) for a period"
        raise ClassError(f"@every({bare[0]:g}) does not say whether that is a rate or a period: write {ways}")
    given = period_s if hz is None else hz
    if given is None or (hz is not None and period_s is not None):
        raise ClassError("@every takes either a rate or a period: write @every(hz=10), or @every(period_s=0.1)")
    if not isinstance(given, Real) or isinstance(given, bool):
        raise ClassError(f"@every takes a number, not {given!r}: write @every(hz=10), or @every(period_s=0.1)")
    try:
        return Period(period_of(given) if hz is not None else checked_period(given))
    except ValueError as error:
        raise ClassError(f"@every: {error}") from None


def period_of(rate_hz: float) -> float:
    """Return the period of a rate, in seconds; infinity for 0.

    Raises:
        ValueError: the rate is negative, no number, or above `MOST_HZ`.
    """
    if not 0 <= rate_hz <= MOST_HZ:
        raise ValueError(f"a rate must lie between 0 and {MOST_HZ:,.0f} ticks a second, not {rate_hz:g}")
    return 1.0 / rate_hz if rate_hz > 0 else float("inf")


def checked_period(period_s: float) -> float:
    """Return a period that a timer may have, in seconds; infinity lets it rest.

    Raises:
        ValueError: it is shorter than that of `MOST_HZ`, or no number.
    """
    if not period_s >= 1.0 / MOST_HZ:
        raise ValueError(f"a period must be at least {1.0 / MOST_HZ:g} s, not {period_s:g} s")
    return float(period_s)


def subscriptions_of(cls: type) -> list[tuple[Subscription, str]]:
    """Return what the methods of a class listen to, as (subscription, method name), in the order of the class."""
    return [
        (subscription, name) for name in _names(cls) for subscription in getattr(getattr(cls, name), SUBSCRIPTIONS, ())
    ]


def periods_of(cls: type) -> dict[str, Period]:
    """Return the time-driven methods of a class, in the order of the class."""
    return {name: period for name in _names(cls) if (period := getattr(getattr(cls, name), PERIOD, None)) is not None}


def answers_of(cls: type) -> dict[str, str]:
    """Return the names of the methods of a class that answer requests, by the packet type of the request.

    Raises:
        ClassError: two of them answer the same.
    """
    found: dict[str, str] = {}
    for name in _names(cls):
        request = getattr(getattr(cls, name), ANSWERS, None)
        if request is None:
            continue
        other = found.setdefault(type_name(request), name)
        if other != name:
            raise ClassError(
                f"{_head(getattr(cls, name))} answers {request.__name__}, as {other} does, and a request has one"
                " answer: leave one of them out"
            )
    return found


def _both(method: Any) -> ClassError:
    return ClassError(
        f"{_head(method)} is decorated with both @on and @every, and one gives it a Packet, the other a Tick: write two"
        " methods, which may call a third"
    )


def _head(method: Any) -> str:
    return f"{place_of_function(method)}: {getattr(method, '__qualname__', method).rpartition('<locals>.')[2]}"


def _name_of(method: Any) -> str:
    return str(getattr(method, "__name__", "handle"))


def _names(cls: type) -> list[str]:
    # Bases first, each in the order of its text; an overriding method keeps the place of what it overrides.
    names = {name: None for base in reversed(cls.__mro__) for name in vars(base) if not name.startswith("__")}
    return [name for name in names if callable(getattr(cls, name, None))]


MOST_PLANS: Final = 1024
"""The most classes that are remembered; a program that makes one class after the other must not keep them all."""

Handler = Callable[[Any, Packet], None]
"""What a component does with a packet; called with the component and the packet."""


class Handlers(dict[str | None, tuple[Handler, ...]]):
    """What a component does with the packets of one channel, by their type: all of its handlers for it, in order."""

    __slots__ = ("for_all",)

    def __init__(self, like: Handlers | None = None) -> None:
        super().__init__(like or {})
        self.for_all: tuple[Handler, ...] = like.for_all if like is not None else ()

    def add(self, type_name: str | None, handler: Handler) -> None:
        """Add a handler; those for all types (None) come after those for one."""
        if type_name is None:
            self.for_all = (*self.for_all, handler)
            for name in self:
                self[name] = (*self[name], handler)
        else:
            own = self[type_name]
            before = len(own) - len(self.for_all)
            self[type_name] = (*own[:before], handler, *own[before:])

    def __missing__(self, type_name: str | None) -> tuple[Handler, ...]:
        return self.for_all


NO_HANDLERS = Handlers()


class Plan(NamedTuple):
    """What the methods of a class react to.

    Attributes:
        subscriptions: the packets.
        handlers: what is done with them, by channel; all components of the class share that, which is a kilobyte less
            for each. Not to be changed.
        periods: the time-driven methods.
        awaits: whether one of its methods is `async def`.
        answers: the names of the methods that answer requests, by the packet type of the request.
    """

    subscriptions: tuple[Subscription, ...]
    handlers: dict[str, Handlers]
    periods: dict[str, Period]
    awaits: bool
    answers: dict[str, str]


HOOKS_AWAITED: Final = ("on_start", "on_stop")
"""The hooks of a task that may be `async def`."""


@lru_cache(maxsize=MOST_PLANS)
def plan_of(cls: type, core: type | None = None) -> Plan:
    """Return what the methods of a class react to; each class is read once.

    Args:
        cls: the class of a component.
        core: the class of its core, if that is an object of its own: what it reacts to comes first.
    """
    handlers: dict[str, Handlers] = {}
    marked = [(subscription, getattr(cls, method)) for subscription, method in subscriptions_of(cls)]
    channels_awaited = {subscription.channel for subscription, method in marked if is_async(method)}
    adapted = [(it, adapted_handler(method, it.channel in channels_awaited)) for it, method in marked]
    if core is not None:
        adapted = [*((it, _by_core(getattr(core, method))) for it, method in subscriptions_of(core)), *adapted]
    for subscription, handler in adapted:
        handle = only_addressed(handler) if subscription.addressed else handler
        handlers.setdefault(subscription.channel, Handlers()).add(subscription.type, handle)
    periods = periods_of(cls)
    answers = answers_of(cls)
    others = (*periods, *HOOKS_AWAITED, *answers.values())
    awaits = bool(channels_awaited) or any(is_async(getattr(cls, name, None)) for name in others)
    return Plan(tuple(subscription for subscription, _ in adapted), handlers, periods, awaits, answers)


def adapted_handler(method: Callable[..., Any], beside_async: bool = False) -> Handler:
    """Return what is called with a component and a packet, for a method that may take a body, and may be `async def`.

    Args:
        method: the method.
        beside_async: whether another handler of the same packets is `async def`, which this one must wait for.
    """
    given = getattr(method, GIVEN, Given.PACKET)
    handler: Callable[[Any, Packet], Any] = method
    if given is Given.BODY:

        def handler(component: Any, packet: Packet) -> Any:
            return method(component, packet.body)

    elif given is Given.BODY_AND_PACKET:

        def handler(component: Any, packet: Packet) -> Any:
            return method(component, packet.body, packet)

    if is_async(method):
        return lambda component, packet: component._actor.await_between_turns(handler(component, packet))  # noqa: SLF001
    if beside_async:
        return lambda component, packet: component._actor.after_awaiting(partial(handler, component, packet))  # noqa: SLF001
    return handler


def adapted_tick(method: Callable[..., Any]) -> Callable[[Any, Tick], None]:
    """Return what is called with a component and a tick, for a method that may be `async def`."""
    if is_async(method):
        return lambda component, tick: component._actor.await_between_turns(method(component, tick))  # noqa: SLF001
    return method


def _by_core(handler: Handler) -> Handler:
    """Call a handler with the core of the component."""
    return lambda component, packet: handler(component._actor, packet)  # noqa: SLF001


def only_addressed(handler: Handler) -> Handler:
    """Keep from a handler what another subscription of its component to the same type brings in."""

    def handle(component: Any, packet: Packet) -> None:
        if packet.destination not in ("", component.agent) and covers(packet.destination, component.address):
            handler(component, packet)

    return handle
