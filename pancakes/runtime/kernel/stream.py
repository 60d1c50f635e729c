"""The information stream: the channels on which the components of an agent talk (paper §3.1)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from pancakes.errors import MailboxFull, PancakesError, UnknownChannel
from pancakes.packet import CORE_CHANNELS, CTRL, NEIGHBOURS, TO_TASK, Packet, agent_of, covers
from pancakes.runtime.foundation.names import fault_of_name
from pancakes.runtime.foundation.signatures import check_called
from pancakes.runtime.foundation.suggestion import hint_of
from pancakes.runtime.kernel.handlers import Subscription
from pancakes.runtime.kernel.mailbox import Mailbox
from pancakes.runtime.kernel.route import Listener, Route, Tap
from pancakes.runtime.weight import LIGHT_BYTES, weight_of

Gateway = Callable[[Packet], None]
"""Takes packets whose destination is elsewhere. Called in the publisher's thread, must not block."""

MOST_ROUTES = 4096
"""So many snapshots are kept; a peer that makes up one type or destination after the other must not fill the memory."""


class InformationStream:
    """The channels of one agent.

    Publishing costs no hop: the publisher's thread reads an immutable snapshot of the subscribers and puts
    the packet into their mailboxes. All methods may be called from any thread.

    Args:
        agent: the agent's name.

    Attributes:
        gateway: takes packets whose destination is another agent; the Network Service sets it.
        courier: takes packets whose destination is a task, wherever it is.
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
                raise UnknownChannel(f"{self.agent} has no channel {name!r}{hint_of(name, self._readers)}")
            del self._readers[name]
            self._taps.pop(name, None)
            self._forget(name)

    def publish(self, packet: Packet) -> int:
        """Gives a packet to all that it concerns.

        Returns:
            How many components of this agent got it.

        Raises:
            UnknownChannel: there is no such channel here.
            MailboxFull: a `reliable` subscriber has no room, or too many packets for the task that is its destination
                wait already; no subscriber got the packet.
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
            self._route_of(packet, destination).give_where_room(packet, weight_of(packet.body))
            raise

    def inject_all(
        self, packets: Sequence[Packet], refused: Callable[[Packet, PancakesError], None], size: int | None = None
    ) -> None:
        """Publishes packets that came from another agent: on one channel, of one type and with one destination.

        The stream looks once for the components that get them, and tells each once that something waits.

        Args:
            packets: the packets, in their order.
            refused: called with each packet that found no room, or no channel, and why; see `inject`.
            size: how many bytes they took on the wire, where that is known.
        """
        first = packets[0]
        destination = "" if first.destination == NEIGHBOURS else first.destination
        route = self._routes.get((first.channel, first.type, destination))
        if route is not None and size is not None and route.queues and not route.reliable and not route.taps:
            each = size // len(packets)
            route.give_all(packets, each if each > LIGHT_BYTES else 0)
            return
        for packet in packets:
            try:
                self.inject(packet)
            except PancakesError as error:
                refused(packet, error)

    def tap(self, channel: str, tap: Tap, types: tuple[str, ...] = (), by: str = "") -> None:
        """Calls `tap` with every packet published here on `channel`, in the publisher's thread; it must not block.

        Args:
            channel: the channel.
            tap: what is called.
            types: the types of the packets that it sees; empty: all.
            by: the address of the follower elsewhere for which it hears; empty: it hears for none.

        Raises:
            UnknownChannel: there is no such channel.
            ClassError: it is `async def`, or cannot be called with a packet.
        """
        check_called(tap, ("packet",), "a tap is called with each packet", "def hear(packet: Packet) -> None")
        with self._lock:
            if channel not in self._readers:
                raise UnknownChannel(f"{self.agent} has no channel {channel!r}{hint_of(channel, self._readers)}")
            self._taps[channel] = (*self._taps.get(channel, ()), (tap, types, by))
            self._forget(channel)

    def untap(self, channel: str, tap: Tap) -> None:
        """Ends what `tap` began."""
        with self._lock:
            self._taps[channel] = tuple(other for other in self._taps.get(channel, ()) if other[0] != tap)
            self._forget(channel)

    def tap_outgoing(self, tap: Tap) -> None:
        """Calls `tap` with every packet published here for another agent, as `tap` does."""
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
        """Ends all subscriptions of a component."""
        with self._lock:
            for channel, readers in self._readers.items():
                if readers.pop(address, None) is not None:
                    self._forget(channel)

    def silence(self) -> None:
        """Ends all subscriptions and taps: no subscriber gets what is published from now on."""
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

    def followers(self, channel: str) -> list[str]:
        """Returns the addresses of the followers of a channel that are elsewhere."""
        return [by for _, _, by in self._taps.get(channel, ()) if by]

    def describe(self, channel: str) -> list[dict[str, Any]]:
        """Returns the readers of a channel, with their bounds, and what waits or was lost there, as plain values.

        Raises:
            UnknownChannel: there is no such channel.
        """
        with self._lock:
            readers = self._readers.get(channel)
            if readers is None:
                raise UnknownChannel(f"{self.agent} has no channel {channel!r}{hint_of(channel, self._readers)}")
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
        """Makes the snapshot for packets like this one; an empty destination means all subscribers here."""
        with self._lock:
            readers = self._readers.get(packet.channel)
            if readers is None:
                raise self._unknown(packet)
            is_addressed = destination not in ("", self.agent)
            listeners = [
                reader
                for reader in readers.values()
                if (not destination or covers(destination, reader.address))
                and reader.reads(packet.type, addressed=is_addressed)
            ]
            # A stable order of those that are told, which decides the order of their turns in virtual time.
            listeners.sort(key=lambda reader: len(reader.bounds) > 1)
            route = Route(
                tuple(reader.queue for reader in listeners),
                tuple(reader for reader in listeners if reader.keep_of(packet.type).reliable),
                tuple(tap for tap, types, _ in self._taps.get(packet.channel, ()) if not types or packet.type in types),
            )
            if len(self._routes) >= MOST_ROUTES:
                self._routes.clear()
            self._routes[packet.channel, packet.type, destination] = route
            return route

    def _give(self, packet: Packet, destination: str) -> int:
        route = self._route_of(packet, destination)
        route.give(packet, weight_of(packet.body) if route.queues else 0)
        if not route.queues:
            if destination and not route.taps:
                self.undelivered += 1
            if destination or packet.channel == CTRL:
                self.unheard(packet)
        return len(route.queues)

    def _unknown(self, packet: Packet) -> UnknownChannel:
        return UnknownChannel(
            f"{packet.source} published {packet.type!r} to {packet.channel!r}, but {self.agent} has no such channel"
            f"{hint_of(packet.channel, self._readers)}"
        )
