"""The information stream: the channels on which the components of an agent talk (paper §3.1).

Publishing costs no hop. The publisher's thread reads a `Route`, an immutable snapshot of the readers of one type and
destination, and puts the packet into their mailboxes. Any thread may call it. Packets for other agents go to the
gateway, packets for a task wherever it is go to the courier.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import msgspec

from pancakes.errors import MailboxFullError, PancakesError, UnknownChannelError
from pancakes.kernel.handlers import Subscription
from pancakes.kernel.mailbox import ChannelQueue, Mailbox, TypeQueue
from pancakes.kernel.payload_size import LIGHT_BYTES, is_small, weight_of
from pancakes.packet import CORE_CHANNELS, CTRL, NEIGHBOURS, TO_TASK, Packet, agent_of, covers, type_of
from pancakes.packet import body_class as body_class_of
from pancakes.util.class_checks import check_called
from pancakes.util.text import fault_of_name, hint_of

Tap = Callable[[Packet], None]


class Listener(msgspec.Struct):
    """One component that reads one channel.

    Attributes:
        types: those that it reads; None means all.
        open_types: those of the types that it gets whatever their destination.
    """

    address: str
    mailbox: Mailbox
    queue: ChannelQueue
    types: tuple[str | None, ...] = ()
    open_types: tuple[str | None, ...] = ()

    def add(self, subscription: Subscription) -> None:
        """Add what it reads."""
        if subscription.type not in self.types:
            self.types = (*self.types, subscription.type)
        if not subscription.addressed and subscription.type not in self.open_types:
            self.open_types = (*self.open_types, subscription.type)
        self.queue.bound(subscription.type, subscription.queue)

    def reads(self, type_name: str, addressed: bool) -> bool:
        """Return whether a packet of this type is for it; `addressed`: its destination names it."""
        types = self.types if addressed else self.open_types
        return type_name in types or None in types

    def describe(self) -> dict[str, Any]:
        """Return its address and how it reads, as plain values."""
        return {"address": self.address, **self.bounds_and_queue()}

    def bounds_and_queue(self) -> dict[str, Any]:
        """Return how it reads, as plain values: types are None for all of them; `limit` counts packets.

        `queue` is as an author writes it: `latest`, `100` or `reliable(100)`; several if its types have different ones.

        `waiting_bytes` are those of the heavy packets among them, which `MOST_BYTES` bounds.

        It gets `open_types` whatever their destination, the other `types` only if a packet's destination names it.
        """
        policies = [self.queue.of(name).policy for name in self.types]
        return {
            "types": _names(self.types),
            "open_types": _names(self.open_types),
            "queue": ", ".join(dict.fromkeys(map(str, policies))),
            "limit": sum(policy.limit for policy in policies),
            "waiting": len(self.queue),
            "waiting_bytes": self.queue.heavy_bytes,
            "dropped": self.queue.dropped(),
        }


class Route(msgspec.Struct, frozen=True):
    """Where packets of one type and destination on one channel go: an immutable snapshot, read without a lock.

    Attributes:
        type: the name of the packets' type.
        queues: where they wait for each component here that gets them.
        reliable: those of the queues that may refuse a packet.
        taps: functions that see the packets besides, or carry them to where they go.
        light: whether the bodies of all of them are of one small size.
    """

    type: str
    queues: tuple[TypeQueue, ...]
    reliable: tuple[TypeQueue, ...]
    taps: tuple[Tap, ...]
    light: bool

    def give(self, packet: Packet) -> None:
        """Give a packet to all of them, or to none.

        Raises:
            MailboxFullError: a `reliable` subscriber has no room; no subscriber got the packet.
        """
        weight = 0 if self.light else weight_of(packet.body)
        # All reliable readers are asked before any of them gets the packet: a retry must not double it.
        if self.reliable:
            for queue in self.reliable:
                if queue.refuses(weight):
                    raise _no_room(queue, packet, weight)
        for queue in self.queues:
            queue.put(packet, weight)
        if self.taps:
            for tap in self.taps:
                tap(packet)

    def give_all(self, packets: Sequence[Packet], weight: int) -> None:
        """Give packets if no reader may refuse one; `weight`: the bytes of each, if heavy."""
        for packet in packets:
            for queue in self.queues:
                queue.put(packet, weight)
            for tap in self.taps:
                tap(packet)

    def give_if_room(self, packet: Packet) -> None:
        """Give a packet, which cannot come again, to all of them that have room, and count it for the others."""
        weight = weight_of(packet.body)
        for queue in self.queues:
            if queue.refuses(weight):
                queue.channel.refused += 1
            else:
                queue.put(packet, weight)
        for tap in self.taps:
            tap(packet)


def _no_room(queue: TypeQueue, packet: Packet, weight: int) -> MailboxFullError:
    waiting = queue.channel
    reader = waiting.mailbox.component
    return MailboxFullError(
        f"{reader.address if reader else 'a task between restarts'} has no room for {packet.type!r} from"
        f" {packet.source} on {packet.channel!r}: {len(waiting)}"
        + (f" ({waiting.heavy_bytes} bytes) wait already" if weight else " wait already")
    )


def _names(types: Collection[str | None]) -> list[str] | None:
    """Return the names of types, sorted; None if all types are meant."""
    return None if None in types else sorted(str(name) for name in types)


Gateway = Callable[[Packet], None]
"""Takes packets whose destination is elsewhere. Called in the publisher's thread, must not block."""

MOST_ROUTES = 4096
"""The most snapshots that are kept: a peer that makes up type after type, or destinations, must not fill the memory."""


class InformationStream:
    """The channels of one agent.

    Publishing costs no hop: the publisher's thread reads an immutable snapshot of the subscribers and puts
    the packet into their mailboxes. All methods may be called from any thread.

    Args:
        agent: the agent's name.

    Attributes:
        gateway: takes packets whose destination is another agent; the Network Service sets it.
        courier: takes packets whose destination is a task, wherever it is.
        routes: where packets go, by channel, type and destination; those of publishers here by the class of the body.
            A publisher reads it with each packet, and any thread may: an entry never changes, but may go.
        unheard: takes packets for a component of this agent, and commands, that none got; the kernel sets it.
    """

    def __init__(self, agent: str) -> None:
        self.agent = agent
        self.gateway: Gateway | None = None
        self.courier: Gateway | None = None
        self.unheard: Gateway = lambda packet: None
        self._lock = threading.Lock()
        self._readers: dict[str, dict[str, Listener]] = {name: {} for name in CORE_CHANNELS}
        # And the types that each wants to see, and the follower elsewhere for which it does.
        self._taps: dict[str, tuple[tuple[Tap, tuple[str, ...], str], ...]] = {}
        self._outgoing: tuple[Tap, ...] = ()
        self._openers: tuple[Callable[[str], None], ...] = ()
        self.routes: dict[tuple[str, type | str, str], Route] = {}
        self.undelivered = 0

    def channels(self) -> list[str]:
        """Return the names of all channels, core channels first."""
        return list(self._readers)

    def open(self, name: str) -> None:
        """Add a channel; one that is there already is left alone.

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
        """Call `tell` with the name of each channel that there is, and of each that is opened from now on.

        For what is opened later it is called in the thread that opens it, before that publishes anything there.
        """
        with self._lock:
            self._openers = (*self._openers, tell)
            there = list(self._readers)
        for name in there:
            tell(name)

    def close(self, name: str) -> None:
        """Remove a channel and its subscriptions.

        Raises:
            UnknownChannelError: there is no such channel, or it is a core channel.
        """
        with self._lock:
            if name in CORE_CHANNELS:
                raise UnknownChannelError(f"{name!r} is a core channel and cannot be removed")
            if name not in self._readers:
                raise UnknownChannelError(f"{self.agent} has no channel {name!r}{hint_of(name, self._readers)}")
            del self._readers[name]
            self._taps.pop(name, None)
            self._forget(name)

    def publish(self, packet: Packet) -> int:
        """Give a packet to all that it concerns.

        Returns:
            How many components of this agent got it.

        Raises:
            UnknownChannelError: there is no such channel here.
            MailboxFullError: a `reliable` subscriber has no room, or too many packets for the task that is its
                destination wait already; no subscriber got the packet.
            LocalProtocolError: its destination is elsewhere and its body cannot travel, or is no task.
        """
        route = self._route_of(packet.channel, packet.type, packet.destination, packet.source)
        route.give(packet)
        return len(route.queues)

    def new_route(self, channel: str, body: Any, destination: str, source: str) -> Route:
        """Return where packets with such a body go, for a publisher that did not find it in `routes`.

        Args:
            channel: their channel.
            body: an instance of a registered packet type.
            destination: empty: all subscribers here.
            source: their publisher.

        Raises:
            UnknownChannelError: there is no such channel here.
            LocalProtocolError: the body is of no registered type.
        """
        return self._new_route(channel, type_of(body), destination, source, body.__class__)

    def inject(self, packet: Packet) -> int:
        """Publish a packet that came from another agent, on its own channel here.

        Returns:
            How many components of this agent it was for.

        Raises:
            UnknownChannelError: as `publish`.
            MailboxFullError: a `reliable` subscriber has no room. The publisher cannot be asked to wait, so all others
                get the packet, and for this one it counts as dropped.
        """
        destination = "" if packet.destination == NEIGHBOURS else packet.destination
        if destination and agent_of(destination) != self.agent:  # it must not go out again
            self.undelivered += 1
            return 0
        route = self._route_of(packet.channel, packet.type, destination, packet.source)
        try:
            route.give(packet)
        except MailboxFullError:
            # It may be another route by now, or none: readers come and go.
            self._route_of(packet.channel, packet.type, destination, packet.source).give_if_room(packet)
            raise
        return len(route.queues)

    def inject_all(
        self, packets: Sequence[Packet], refused: Callable[[Packet, PancakesError], None], size: int | None = None
    ) -> None:
        """Publish packets that came from another agent: on one channel, of one type and with one destination.

        The stream looks once for the components that get them, and tells each once that something waits.

        Args:
            packets: the packets, in their order.
            refused: called with each packet that found no room, or no channel, and why; see `inject`.
            size: how many bytes they took on the wire, if that is known.
        """
        first = packets[0]
        destination = "" if first.destination == NEIGHBOURS else first.destination
        route = self.routes.get((first.channel, first.type, destination))
        if route is not None and size is not None and route.queues and not route.reliable:
            each = size // len(packets)
            route.give_all(packets, each if each > LIGHT_BYTES else 0)
            return
        for packet in packets:
            try:
                self.inject(packet)
            except PancakesError as error:
                refused(packet, error)

    def tap(self, channel: str, tap: Tap, types: tuple[str, ...] = (), by: str = "") -> None:
        """Call `tap` with every packet published here on `channel`, in the publisher's thread; it must not block.

        Args:
            channel: the channel.
            tap: what is called.
            types: the types of the packets that it sees; empty: all.
            by: the address of the follower elsewhere for which it hears; empty: it hears for none.

        Raises:
            UnknownChannelError: there is no such channel.
            ClassError: it is `async def`, or cannot be called with a packet.
        """
        check_called(tap, ("packet",), "a tap is called with each packet", "def hear(packet: Packet) -> None")
        with self._lock:
            if channel not in self._readers:
                raise UnknownChannelError(f"{self.agent} has no channel {channel!r}{hint_of(channel, self._readers)}")
            self._taps[channel] = (*self._taps.get(channel, ()), (tap, types, by))
            self._forget(channel)

    def untap(self, channel: str, tap: Tap) -> None:
        """Undo `tap`."""
        with self._lock:
            self._taps[channel] = tuple(other for other in self._taps.get(channel, ()) if other[0] != tap)
            self._forget(channel)

    def tap_outgoing(self, tap: Tap) -> None:
        """Call `tap` with every packet published here for another agent, as `tap` does."""
        check_called(tap, ("packet",), "a tap is called with each packet", "def hear(packet: Packet) -> None")
        with self._lock:
            self._outgoing = (*self._outgoing, tap)

    def untap_outgoing(self, tap: Tap) -> None:
        """Undo `tap_outgoing`."""
        with self._lock:
            self._outgoing = tuple(other for other in self._outgoing if other != tap)

    def subscribe(self, address: str, mailbox: Mailbox, subscription: Subscription) -> None:
        """Put packets into a component's mailbox from now on.

        Raises:
            UnknownChannelError: there is no such channel.
        """
        with self._lock:
            readers = self._readers.get(subscription.channel)
            if readers is None:
                raise UnknownChannelError(
                    f"{address} cannot subscribe to {subscription.channel!r}: {self.agent} has no such"
                    f" channel{hint_of(subscription.channel, self._readers)}"
                )
            reader = readers.get(address)
            if reader is None:
                queue = mailbox.subscribe(subscription.channel)
                reader = readers[address] = Listener(address, mailbox, queue)
            reader.add(subscription)
            self._forget(subscription.channel)

    def unsubscribe(self, address: str) -> None:
        """End all subscriptions of a component."""
        with self._lock:
            for channel, readers in self._readers.items():
                if readers.pop(address, None) is not None:
                    self._forget(channel)

    def silence(self) -> None:
        """End all subscriptions and taps: no subscriber gets what is published from now on."""
        with self._lock:
            for readers in self._readers.values():
                readers.clear()
            self._taps.clear()
            self._outgoing = ()
            self.routes.clear()
            self.gateway = None
            self.courier = None

    def subscribers(self, channel: str) -> list[str]:
        """Return the addresses of the components that read a channel."""
        return list(self._readers.get(channel, {}))

    def followers(self, channel: str) -> list[str]:
        """Return the addresses of the followers of a channel that are elsewhere."""
        return [by for _, _, by in self._taps.get(channel, ()) if by]

    def describe(self, channel: str) -> list[dict[str, Any]]:
        """Return the readers of a channel, with their bounds, and what waits or was lost there, as plain values.

        Raises:
            UnknownChannelError: there is no such channel.
        """
        with self._lock:
            readers = self._readers.get(channel)
            if readers is None:
                raise UnknownChannelError(f"{self.agent} has no channel {channel!r}{hint_of(channel, self._readers)}")
            return [reader.describe() for reader in readers.values()]

    def readings(self, address: str) -> list[dict[str, Any]]:
        """Return what a component reads: as `describe` says, with the channel instead of the address."""
        with self._lock:
            found = [(name, readers[address]) for name, readers in self._readers.items() if address in readers]
            return [{"channel": name, **reader.bounds_and_queue()} for name, reader in found]

    def _forget(self, channel: str) -> None:
        """Drop the snapshots of one channel; they are built again when they are needed. Under the lock."""
        for key in [key for key in self.routes if key[0] == channel]:
            del self.routes[key]

    def _route_of(self, channel: str, type_name: str, destination: str, source: str) -> Route:
        return self.routes.get((channel, type_name, destination)) or self._new_route(
            channel, type_name, destination, source
        )

    def _new_route(
        self, channel: str, type_name: str, destination: str, source: str, body_class: type | None = None
    ) -> Route:
        """Make the snapshot; `body_class`: the class of all bodies, if it is known."""
        is_elsewhere = destination != "" and agent_of(destination) != self.agent
        known_class = body_class or body_class_of(type_name)
        is_light = is_elsewhere or (known_class is not None and is_small(known_class))
        with self._lock:
            readers = self._readers.get(channel)
            if readers is None:
                raise UnknownChannelError(
                    f"{source} published {type_name!r} to {channel!r}, but {self.agent} has no such channel"
                    f"{hint_of(channel, self._readers)}"
                )
            if is_elsewhere:
                route = Route(type_name, (), (), (self._send,), is_light)
            else:
                taps = tuple(tap for tap, types, _ in self._taps.get(channel, ()) if not types or type_name in types)
                queues = tuple(self._queues(readers.values(), type_name, destination))
                if not queues and (destination or channel == CTRL):
                    taps = (*taps, self._count_unheard if destination and not taps else self._tell_unheard)
                route = Route(
                    type_name,
                    queues,
                    tuple(queue for queue in queues if queue.policy.reliable),
                    taps,
                    is_light or not queues,
                )
            if len(self.routes) >= MOST_ROUTES:
                self.routes.clear()
            self.routes[channel, body_class or type_name, destination] = route
            return route

    def _queues(self, readers: Iterable[Listener], type_name: str, destination: str) -> list[TypeQueue]:
        """Return where packets wait for the readers here that get them; an empty destination means all of them."""
        is_addressed = destination not in ("", self.agent)
        found = [
            reader
            for reader in readers
            if (not destination or covers(destination, reader.address))
            and reader.reads(type_name, addressed=is_addressed)
        ]
        # A stable order of those that are told, which decides the order of their turns in virtual time.
        found.sort(key=lambda reader: len(reader.types) > 1)
        return [reader.queue.of(type_name) for reader in found]

    def _send(self, packet: Packet) -> None:
        """Take a packet whose destination is another agent, or a task."""
        gateway = self.courier if packet.destination.startswith(TO_TASK) else self.gateway
        if gateway is None:
            self.undelivered += 1
        else:
            gateway(packet)
        for tap in self._outgoing:
            tap(packet)

    def _count_unheard(self, packet: Packet) -> None:
        self.undelivered += 1
        self.unheard(packet)

    def _tell_unheard(self, packet: Packet) -> None:
        self.unheard(packet)
