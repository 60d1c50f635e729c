"""The information stream: the channels on which the components of an agent talk (paper §3.1)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import msgspec

from pancakes.errors import MailboxFull, PancakesError, UnknownChannel
from pancakes.kernel.channel_queue import ChannelQueue
from pancakes.kernel.handlers import Subscription
from pancakes.kernel.keep import Keep
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.shared_queue import SharedQueue
from pancakes.names import fault_of_name
from pancakes.packet import CORE_CHANNELS, NEIGHBOURS, TO_TASK, Packet, agent_of, covers
from pancakes.signatures import check_called
from pancakes.weight import LIGHT_BYTES, Weigher, light_on_the_wire, weigher

Tap = Callable[[Packet], None]
Gateway = Callable[[Packet], None]
"""Takes packets whose destination is elsewhere. Called in the publisher's thread, must not block."""

MOST_ROUTES = 4096
"""So many snapshots are kept; a peer that makes up one type or destination after the other must not fill the memory."""


class _Reader(msgspec.Struct):
    """One component that reads one channel."""

    address: str
    mailbox: Mailbox
    bounds: Mapping[str | None, Keep] = {}  # never changed but replaced: its queue has the same
    open_types: tuple[str | None, ...] = ()
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

        `waiting_bytes` are those of the heavy packets among them, which `MOST_BYTES` bounds.

        Of `types` it gets `open_types` from everybody, the others only where a packet's destination names it.
        """
        bounds = list(self.bounds.values())
        return {
            "types": _names(self.bounds),
            "open_types": _names(self.open_types),
            "keep": "reliable" if any(keep.reliable for keep in bounds) else "newest",
            "limit": sum(keep.limit for keep in bounds),
            "waiting": len(self.queue) if self.queue is not None else 0,
            "waiting_bytes": self.queue.heavy_bytes if self.queue is not None else 0,
            "dropped": self.queue.dropped() if self.queue is not None else 0,
        }


class Route(msgspec.Struct, frozen=True):
    """Who gets packets of one type and destination on one channel: an immutable snapshot, read without a lock.

    Attributes:
        type: the name of the packets' type.
        queues: the queues of those who are given each packet, as long as each has one bound only.
        shared: the others.
        reliable: those of all of them that may refuse a packet.
        taps: who sees the packets besides.
        weigh: returns how heavy a packet's body is, where that is not the same, and little, for all of this type.
        light_bytes: a body that takes no more on the wire is light.
    """

    type: str
    queues: tuple[ChannelQueue, ...]
    shared: tuple[ChannelQueue, ...]
    reliable: tuple[ChannelQueue, ...]
    taps: tuple[Tap, ...]
    weigh: Weigher | None = None
    light_bytes: int = 0

    def give(self, packet: Packet) -> None:
        """Gives a packet to all of them, or to none.

        Raises:
            MailboxFull: a `reliable` subscriber has no room; nobody got the packet.
        """
        weigh = self.weigh
        if weigh is not None and (weight := weigh(packet.body)) > LIGHT_BYTES:
            self._give_heavy(packet, weight)
            return
        # All reliable readers are asked before anybody is given the packet: a retry must not double it.
        if self.reliable:
            self._ask(packet)
        # As `ChannelQueue.put`, `enlist` and `Mailbox.take_token`, but without calls: half of what a delivery costs the
        # publisher.
        for queue in self.queues:
            next(queue.numbers)
            queue.items.append(packet)
            if not queue.listed:
                queue.listed = True
                mailbox = queue.mailbox
                mailbox.waiting.append(queue)
                if not mailbox.held:
                    try:
                        del mailbox.token
                    except AttributeError:  # somebody was faster
                        continue
                    mailbox.held = True
                    mailbox.dispatch.ready(mailbox)
        for queue in self.shared:
            queue.put(packet)
        for tap in self.taps:
            tap(packet)

    def takes_many(self, packets: Sequence[Packet], size: int | None) -> bool:
        """Returns whether these packets may be put all at once: nobody can refuse one, and they are light.

        Light in the mean will do, which their bytes on the wire may say without a look at any of them: the number of
        packets that may wait then bounds them as well, but for the part of one frame.
        """
        if self.reliable or self.taps or not (self.queues or self.shared):
            return False
        weigh = self.weigh
        if weigh is None or (size is not None and size <= self.light_bytes * len(packets)):
            return True
        return all(weigh(packet.body) <= LIGHT_BYTES for packet in packets)

    def _give_heavy(self, packet: Packet, weight: int) -> None:
        if self.reliable:
            self._ask(packet, weight)
        for queue in (*self.queues, *self.shared):
            queue.put_heavy(packet, weight)
        for tap in self.taps:
            tap(packet)

    def give_where_room(self, packet: Packet) -> None:
        """Gives a packet, which cannot come again, to all of them that have room, and counts it for the others."""
        weight = self.weigh(packet.body) if self.weigh is not None else 0
        weight = weight if weight > LIGHT_BYTES else 0
        for queue in (*self.queues, *self.shared):
            if queue.full(packet, weight):
                queue.refused += 1
            elif weight:
                queue.put_heavy(packet, weight)
            else:
                queue.put(packet)
        for tap in self.taps:
            tap(packet)

    def _ask(self, packet: Packet, weight: int = 0) -> None:
        for queue in self.reliable:
            if queue.full(packet, weight):
                reader = queue.mailbox.component
                raise MailboxFull(
                    f"{reader.address if reader else 'a task between restarts'} has no room for {packet.type!r} from"
                    f" {packet.source} on {packet.channel!r}: {len(queue)}"
                    + (f" ({queue.heavy_bytes} bytes) wait already" if weight else " wait already")
                )


NOBODY: Final = Route("", (), (), (), ())
"""The route of what is for nobody."""


class InformationStream:
    """The channels of one agent.

    Publishing costs no hop: the publisher's thread reads an immutable snapshot of the subscribers and puts
    the packet into their mailboxes. All methods may be called from any thread.

    Args:
        agent: the agent's name.

    Attributes:
        gateway: takes packets whose destination is another agent; the Network Service sets it.
        courier: takes packets whose destination is a task, wherever it is.
    """

    def __init__(self, agent: str) -> None:
        self.agent = agent
        self.gateway: Gateway | None = None
        self.courier: Gateway | None = None
        self._lock = threading.Lock()
        self._readers: dict[str, dict[str, _Reader]] = {name: {} for name in CORE_CHANNELS}
        self._taps: dict[str, tuple[tuple[Tap, tuple[str, ...]], ...]] = {}  # and the types that each wants to see
        self._outgoing: tuple[Tap, ...] = ()
        self._openers: tuple[Callable[[str], None], ...] = ()
        self._routes: dict[tuple[str, str, str], Route] = {}  # by channel, type and destination
        self.undelivered = 0

    def channels(self) -> list[str]:
        """Returns the names of all channels, core channels first."""
        return list(self._readers)

    def open(self, name: str) -> None:
        """Adds a channel; one that is there already is left alone.

        Raises:
            PancakesError: no channel can have such a name.
        """
        if fault := fault_of_name(name):
            raise PancakesError(f"{self.agent} cannot open this channel: {fault}")
        with self._lock:
            if name in self._readers:
                return
            self._readers[name] = {}
            told = self._openers
        for tell in told:
            tell(name)

    def each_channel(self, tell: Callable[[str], None]) -> None:
        """Calls `tell` with the name of each channel that there is, and of each that is opened from now on.

        For what is opened later it is called in the thread that opens it, before that publishes anything there.
        """
        with self._lock:
            self._openers = (*self._openers, tell)
            there = list(self._readers)
        for name in there:
            tell(name)

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
        gateway, taps = self.courier if destination.startswith(TO_TASK) else self.gateway, self._outgoing
        if gateway is None:
            self.undelivered += 1
        else:
            gateway(packet)
        for tap in taps:
            tap(packet)
        return 0

    def inject(self, packet: Packet) -> int:
        """Publishes a packet that came from another agent, on its own channel here.

        Returns:
            How many components of this agent it was for.

        Raises:
            UnknownChannel: as `publish`.
            MailboxFull: a `reliable` subscriber has no room. The publisher cannot be asked to wait, so all others get
                the packet, and for this one it counts as dropped.
        """
        destination = "" if packet.destination == NEIGHBOURS else packet.destination
        try:
            return self._give(packet, destination)
        except MailboxFull:
            # It may be another route by now, or none: readers come and go.
            self._route_of(packet, destination).give_where_room(packet)
            raise

    def inject_all(
        self, packets: Sequence[Packet], refused: Callable[[Packet, PancakesError], None], size: int | None = None
    ) -> None:
        """Publishes packets that came from another agent: on one channel, of one type and with one destination.

        Who gets them is looked up once, and each reader is told once that something waits.

        Args:
            packets: the packets, in their order.
            refused: called with each packet that found no room, or no channel, and why; see `inject`.
            size: how many bytes they took on the wire, where that is known.
        """
        first = packets[0]
        destination = "" if first.destination == NEIGHBOURS else first.destination
        route = self._routes.get((first.channel, first.type, destination), NOBODY)
        if route.takes_many(packets, size):
            for queue in route.queues:
                queue.put_all(packets)
            for queue in route.shared:
                queue.put_all(packets)
            return
        for packet in packets:
            try:
                self.inject(packet)
            except PancakesError as error:
                refused(packet, error)

    def tap(self, channel: str, tap: Tap, types: tuple[str, ...] = ()) -> None:
        """Calls `tap` with every packet published here on `channel`, in the publisher's thread; it must not block.

        Args:
            channel: the channel.
            tap: what is called.
            types: the types of the packets that it sees; empty: all.

        Raises:
            UnknownChannel: there is no such channel.
            ClassError: it is `async def`, or cannot be called with a packet.
        """
        check_called(tap, ("packet",), "a tap is called with each packet", "def hear(packet: Packet) -> None")
        with self._lock:
            if channel not in self._readers:
                raise UnknownChannel(f"{self.agent} has no channel {channel!r}, only {', '.join(self._readers)}")
            self._taps[channel] = (*self._taps.get(channel, ()), (tap, types))
            self._forget(channel)

    def untap(self, channel: str, tap: Tap) -> None:
        """Ends what `tap` began."""
        with self._lock:
            self._taps[channel] = tuple(other for other in self._taps.get(channel, ()) if other[0] != tap)
            self._forget(channel)

    def tap_outgoing(self, tap: Tap) -> None:
        """Calls `tap` with every packet published here for somebody elsewhere, as `tap` does."""
        check_called(tap, ("packet",), "a tap is called with each packet", "def hear(packet: Packet) -> None")
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
            if reader.bounds:
                reader.bounds = {**reader.bounds, subscription.type: subscription.keep}
            else:
                reader.bounds = _bounds_of_one(subscription.type, subscription.keep)
            if not subscription.addressed and subscription.type not in reader.open_types:
                reader.open_types = (*reader.open_types, subscription.type)
            reader.queue = mailbox.subscribe(subscription.channel, reader.bounds)
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
            self._routes.clear()
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
        for key in [key for key in self._routes if key[0] == channel]:
            del self._routes[key]

    def _route_of(self, packet: Packet, destination: str) -> Route:
        return self._routes.get((packet.channel, packet.type, destination)) or self._new_route(packet, destination)

    def _new_route(self, packet: Packet, destination: str) -> Route:
        """Makes the snapshot for packets like this one; an empty destination means whoever subscribes here."""
        with self._lock:
            readers = self._readers.get(packet.channel)
            if readers is None:
                raise self._unknown(packet)
            names_somebody = destination not in ("", self.agent)
            queues = [
                reader.queue
                for reader in readers.values()
                if reader.queue is not None
                and (not destination or covers(destination, reader.address))
                and reader.reads(packet.type, addressed=names_somebody)
            ]
            route = Route(
                packet.type,
                tuple(queue for queue in queues if not isinstance(queue, SharedQueue)),
                tuple(queue for queue in queues if isinstance(queue, SharedQueue)),
                tuple(queue for queue in queues if queue.has_reliable),
                tuple(tap for tap, types in self._taps.get(packet.channel, ()) if not types or packet.type in types),
                weigher(type(packet.body)),
                light_on_the_wire(type(packet.body)),
            )
            if len(self._routes) >= MOST_ROUTES:
                self._routes.clear()
            self._routes[packet.channel, packet.type, destination] = route
            return route

    def _give(self, packet: Packet, destination: str) -> int:
        route = self._route_of(packet, destination)
        route.give(packet)
        readers = len(route.queues) + len(route.shared)
        if destination and not readers and not route.taps:
            self.undelivered += 1
        return readers

    def _unknown(self, packet: Packet) -> UnknownChannel:
        return UnknownChannel(
            f"{packet.source} published {packet.type!r} to {packet.channel!r}, but {self.agent} has no such channel,"
            f" only {', '.join(self._readers)}"
        )


@lru_cache(maxsize=1024)
def _bounds_of_one(type_name: str | None, keep: Keep) -> Mapping[str | None, Keep]:
    """Returns the bounds of who has subscribed to one type; all tasks of a class share them."""
    return {type_name: keep}


def _names(types: Collection[str | None]) -> list[str] | None:
    """Returns the names of types, sorted; None where all types are meant."""
    return None if None in types else sorted(str(name) for name in types)
