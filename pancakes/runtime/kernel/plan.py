"""What the methods of a class of components react to, read once for each class."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, NamedTuple

from pancakes.packet import Packet, covers
from pancakes.runtime.kernel.handlers import Period, Subscription, periods_of, subscriptions_of

MOST_PLANS: Final = 1024
"""So many classes are remembered; a program that makes one class after the other must not keep them all."""

Handler = Callable[[Any, Packet], None]
"""What a component does with a packet; called with the component and the packet."""


class Handlers(dict[str | None, tuple[Handler, ...]]):
    """What a component does with the packets of one channel, by their type: all of its handlers for it, in order."""

    __slots__ = ("for_all",)

    def __init__(self, like: Handlers | None = None) -> None:
        super().__init__(like or {})
        self.for_all: tuple[Handler, ...] = like.for_all if like is not None else ()

    def add(self, type_name: str | None, handler: Handler) -> None:
        """Adds a handler; those for all types (None) come after those for one."""
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
    """

    subscriptions: tuple[Subscription, ...]
    handlers: dict[str, Handlers]
    periods: dict[str, Period]


@lru_cache(maxsize=MOST_PLANS)
def plan_of(cls: type) -> Plan:
    """Returns what the methods of a class react to; each class is read once."""
    handlers: dict[str, Handlers] = {}
    marked = subscriptions_of(cls)
    for subscription, method in marked:
        handler = getattr(cls, method)
        if subscription.addressed:
            handler = only_addressed(handler)
        handlers.setdefault(subscription.channel, Handlers()).add(subscription.type, handler)
    return Plan(tuple(subscription for subscription, _ in marked), handlers, periods_of(cls))


def only_addressed(handler: Handler) -> Handler:
    """Keeps from a handler what another subscription of its component to the same type brings in."""

    def handle(component: Any, packet: Packet) -> None:
        if packet.destination not in ("", component.agent) and covers(packet.destination, component.address):
            handler(component, packet)

    return handle
