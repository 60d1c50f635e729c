"""The information stream: the channels on which the components of an agent talk (paper §3.1)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from typing import Any

import msgspec

from pancakes.errors import MailboxFull, UnknownChannel
from pancakes.kernel.handlers import Subscription
from pancakes.kernel.mailbox import ChannelQueue, Keep, Mailbox
from pancakes.packet import CORE_CHANNELS, NEIGHBOURS, TO_TASK, Packet, agent_of, covers

Tap = Callable[[Packet], None]

MOST_ROUTES = 4096
"""So many snapshots are kept; a peer that makes up one type or destination after the other must not fill the memory."""


class _Reader(msgspec.Struct):
    """One component that reads one channel."""

    address: str
    mailbox: Mailbox
    bounds: dict[str | None, Keep] = msgspec.field(default_factory=dict)
    open_types: set[str | None] = msgspec.field(default_factory=set)
    queue: ChannelQueue | None = None

    def reads(self, type_name: str, addressed: bool) -> bool:
        """Returns whether a packet of this type is for it; `addressed`: its destination names it."""
        types = self.bounds if addressed else self.open_types
        return type_name in types or None in types

    def describe(self) -> dict[str, Any]:
        """Returns who it is and how it reads, as plain values."""
        return {"address": self.address, **self.bounds_and_queue()}

    def bounds_and_queue(self) -> dict[str, Any]:
        """Returns how it reads, as plain values: types are None for all of them; `limit` counts packets.

        Of `types` it gets `open_types` from everybody, the others only where a packet's destination names it.
        """
        bounds = list(self.bounds.values())
        return {
            "types": _names(self.bounds),
            "open_types": _names(self.open_types),
            "keep": "reliable" if any(keep.reliable for keep in bounds) else "newest",
            "limit": sum(keep.limit for keep in bounds),
            "waiting": len(self.queue) if self.queue is not None else 0,
            "dropped": self.queue.dropped() if self.queue is not None else 0,
        }


class _Route(msgspec.Struct, frozen=True):
    """Who gets packets of one type and destination on one channel: an immutable snapshot, read without a lock."""

    queues: tuple[ChannelQueue, ...]
    reliable: tuple[ChannelQueue, ...]
    taps: tuple[Tap, ...]


class InformationStream:
    """The channels of one agent.

    Publishing costs no hop: the publisher's thread reads an immutable snapshot of the subscribers and puts
    the packet into their mailboxes. All methods may be called from any thread.

    Args:
        agent: the agent's name.

    Attributes:
        gateway: takes packets whose destination is another agent; the Network Service sets it. Called in
            the publisher's thread, must not block.
        courier: takes packets whose destination is a task, wherever it is; likewise.
    """

    def __init__(self, agent: str) -> None:
        self.agent = agent
        self.gateway: Tap | None = None
        self.courier: Tap | None = None
        self._lock = threading.Lock()
        self._readers: dict[str, dict[str, _Reader]] = {name: {} for name in CORE_CHANNELS}
        self._taps: dict[str, tuple[Tap, ...]] = {}
        self._outgoing: tuple[Tap, ...] = ()
        self._routes: dict[tuple[str, str, str], _Route] = {}  # by channel, type and destination
        self.undelivered = 0

    def channels(self) -> list[str]:
        """Returns the names of all channels, core channels first."""
        return list(self._readers)

    def open(self, name: str) -> None:
        """Adds a channel; one that is there already is left alone."""
        with self._lock:
            self._readers.setdefault(name, {})

    def close(self, name: str) -> None:
        """Removes a channel and its subscriptions.

        Raises:
            UnknownChannel: there is no such channel, or it is a core channel.
        """
        with self._lock:
            if name in CORE_CHANNELS:
                raise UnknownChannel(f"{name!r} is a core channel and cannot be removed")
            if name not in self._readers:
                raise UnknownChannel(f"{self.agent} has no channel {name!r}, only {', '.join(self._readers)}")
            del self._readers[name]
            self._taps.pop(name, None)
            self._forget(name)

    def publish(self, packet: Packet) -> int:
        """Gives a packet to everybody whom it concerns.

        Returns:
            How many components of this agent got it.

        Raises:
            UnknownChannel: there is no such channel here.
            MailboxFull: a `reliable` subscriber has no room, or too many packets for the task that is its destination
                wait already; nobody got the packet.
            LocalProtocolError: its destination is elsewhere and its body cannot travel, or is no task.
        """
        destination = packet.destination
        if not destination:
            return self._give(packet, "")
        if agent_of(destination) == self.agent:
            return self._give(packet, destination)
        if packet.channel not in self._readers:
            raise self._unknown(packet)
        gateway = self.courier if destination.startswith(TO_TASK) else self.gateway
        if gateway is None:
            self.undelivered += 1
        else:
            gateway(packet)
        for tap in self._outgoing:
            tap(packet)
        return 0

    def inject(self, packet: Packet) -> int:
        """Publishes a packet that came from another agent, on its own channel here.

        Returns:
            How many components of this agent got it.

        Raises:
            UnknownChannel, MailboxFull: as `publish`.
        """
        return self._give(packet, "" if packet.destination == NEIGHBOURS else packet.destination)

    def tap(self, channel: str, tap: Tap) -> None:
        """Calls `tap` with every packet published here on `channel`, in the publisher's thread; it must not block.

        Raises:
            UnknownChannel: there is no such channel.
        """
        with self._lock:
            if channel not in self._readers:
                raise UnknownChannel(f"{self.agent} has no channel {channel!r}, only {', '.join(self._readers)}")
            self._taps[channel] = (*self._taps.get(channel, ()), tap)
            self._forget(channel)

    def untap(self, channel: str, tap: Tap) -> None:
        """Ends what `tap` began."""
        with self._lock:
            self._taps[channel] = tuple(other for other in self._taps.get(channel, ()) if other != tap)
            self._forget(channel)

    def tap_outgoing(self, tap: Tap) -> None:
        """Calls `tap` with every packet published here for somebody elsewhere, as `tap` does."""
        with self._lock:
            self._outgoing = (*self._outgoing, tap)

    def untap_outgoing(self, tap: Tap) -> None:
        """Ends what `tap_outgoing` began."""
        with self._lock:
            self._outgoing = tuple(other for other in self._outgoing if other != tap)

    def subscribe(self, address: str, mailbox: Mailbox, subscription: Subscription) -> None:
        """Puts packets into a component's mailbox from now on.

        Raises:
            UnknownChannel: there is no such channel.
        """
        with self._lock:
            readers = self._readers.get(subscription.channel)
            if readers is None:
                raise UnknownChannel(
                    f"{address} cannot subscribe to {subscription.channel!r}: {self.agent} has no such channel,"
                    f" only {', '.join(self._readers)}"
                )
            reader = readers.get(address)
            if reader is None:
                reader = readers[address] = _Reader(address, mailbox)
            reader.bounds[subscription.type] = subscription.keep
            if not subscription.addressed:
                reader.open_types.add(subscription.type)
            reader.queue = mailbox.subscribe(subscription.channel, dict(reader.bounds))
            self._forget(subscription.channel)

    def unsubscribe(self, address: str) -> None:
        """Ends all subscriptions of a component."""
        with self._lock:
            for channel, readers in self._readers.items():
                if readers.pop(address, None) is not None:
                    self._forget(channel)

    def silence(self) -> None:
        """Ends all subscriptions and taps: what is published from now on reaches nobody."""
        with self._lock:
            for readers in self._readers.values():
                readers.clear()
            self._taps.clear()
            self._outgoing = ()
            self._routes = {}
            self.gateway = None
            self.courier = None

    def subscribers(self, channel: str) -> list[str]:
        """Returns the addresses of the components that read a channel."""
        return list(self._readers.get(channel, {}))

    def describe(self, channel: str) -> list[dict[str, Any]]:
        """Returns who reads a channel, with which bounds, and what waits or was lost there, as plain values.

        Raises:
            UnknownChannel: there is no such channel.
        """
        with self._lock:
            readers = self._readers.get(channel)
            if readers is None:
                raise UnknownChannel(f"{self.agent} has no channel {channel!r}, only {', '.join(self._readers)}")
            return [reader.describe() for reader in readers.values()]

    def readings(self, address: str) -> list[dict[str, Any]]:
        """Returns what a component reads: as `describe` says, with the channel instead of the address."""
        with self._lock:
            found = [(name, readers[address]) for name, readers in self._readers.items() if address in readers]
            return [{"channel": name, **reader.bounds_and_queue()} for name, reader in found]

    def _forget(self, channel: str) -> None:
        """Drops the snapshots of one channel; they are built again when they are needed. Under the lock."""
        self._routes = {key: route for key, route in self._routes.items() if key[0] != channel}

    def _route(self, packet: Packet, destination: str) -> _Route:
        """Makes the snapshot for packets like this one; an empty destination means whoever subscribes here."""
        with self._lock:
            readers = self._readers.get(packet.channel)
            if readers is None:
                raise self._unknown(packet)
            names_somebody = destination not in ("", self.agent)
            queues = tuple(
                reader.queue
                for reader in readers.values()
                if reader.queue is not None
                and (not destination or covers(destination, reader.address))
                and reader.reads(packet.type, addressed=names_somebody)
            )
            route = _Route(queues, _reliable(queues), self._taps.get(packet.channel, ()))
            if len(self._routes) >= MOST_ROUTES:
                self._routes = {}
            self._routes[packet.channel, packet.type, destination] = route
            return route

    def _give(self, packet: Packet, destination: str) -> int:
        route = self._routes.get((packet.channel, packet.type, destination)) or self._route(packet, destination)
        # All reliable readers are asked before anybody is given the packet: a retry must not double it.
        if route.reliable:
            self._ask(route.reliable, packet)
        for queue in route.queues:
            queue.put(packet)
        for tap in route.taps:
            tap(packet)
        if destination and not route.queues and not route.taps:
            self.undelivered += 1
        return len(route.queues)

    def _ask(self, queues: tuple[ChannelQueue, ...], packet: Packet) -> None:
        for queue in queues:
            if queue.full(packet):
                reader = queue.mailbox.component
                raise MailboxFull(
                    f"{reader.address if reader else 'a task between restarts'} has no room for {packet.type!r} from"
                    f" {packet.source} on {packet.channel!r}: {queue.keep.limit} wait already"
                )

    def _unknown(self, packet: Packet) -> UnknownChannel:
        return UnknownChannel(
            f"{packet.source} published {packet.type!r} to {packet.channel!r}, but {self.agent} has no such channel,"
            f" only {', '.join(self._readers)}"
        )


def _names(types: Collection[str | None]) -> list[str] | None:
    """Returns the names of types, sorted; None where all types are meant."""
    return None if None in types else sorted(str(name) for name in types)


def _reliable(queues: tuple[ChannelQueue, ...]) -> tuple[ChannelQueue, ...]:
    return tuple(queue for queue in queues if queue.has_reliable)
