"""Which components get packets of one type and destination on one channel."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import msgspec

from pancakes.errors import MailboxFull
from pancakes.packet import Packet
from pancakes.runtime.kernel.channel_queue import ChannelQueue
from pancakes.runtime.kernel.handlers import Subscription
from pancakes.runtime.kernel.keep import Keep
from pancakes.runtime.kernel.mailbox import Mailbox

Tap = Callable[[Packet], None]


class Listener(msgspec.Struct):
    """One component that reads one channel.

    Attributes:
        bounds: by the types that it reads, None for all others.
        open_types: those of the types that it gets whatever their destination.
    """

    address: str
    mailbox: Mailbox
    queue: ChannelQueue
    bounds: dict[str | None, Keep] = {}
    open_types: tuple[str | None, ...] = ()

    def add(self, subscription: Subscription) -> None:
        """Adds what it reads."""
        self.bounds[subscription.type] = subscription.keep
        if not subscription.addressed and subscription.type not in self.open_types:
            self.open_types = (*self.open_types, subscription.type)
        self.queue.bound(self.bounds)

    def reads(self, type_name: str, addressed: bool) -> bool:
        """Returns whether a packet of this type is for it; `addressed`: its destination names it."""
        types: Collection[str | None] = self.bounds if addressed else self.open_types
        return type_name in types or None in types

    def keep_of(self, type_name: str) -> Keep:
        """Returns the bound of packets of a type that it reads."""
        return self.bounds.get(type_name) or self.bounds[None]

    def refuse(self, packet: Packet, weight: int) -> None:
        """Raises `MailboxFull` where it has no room for a packet that it must not lose."""
        if not self.queue.refuses(packet, weight):
            return
        reader = self.mailbox.component
        raise MailboxFull(
            f"{reader.address if reader else 'a task between restarts'} has no room for {packet.type!r} from"
            f" {packet.source} on {packet.channel!r}: {len(self.queue)}"
            + (f" ({self.queue.heavy_bytes} bytes) wait already" if weight else " wait already")
        )

    def describe(self) -> dict[str, Any]:
        """Returns its address and how it reads, as plain values."""
        return {"address": self.address, **self.bounds_and_queue()}

    def bounds_and_queue(self) -> dict[str, Any]:
        """Returns how it reads, as plain values: types are None for all of them; `limit` counts packets.

        `waiting_bytes` are those of the heavy packets among them, which `MOST_BYTES` bounds.

        It gets `open_types` whatever their destination, the other `types` only where a packet's destination names it.
        """
        keeps = list(self.bounds.values())
        return {
            "types": _names(self.bounds),
            "open_types": _names(self.open_types),
            "keep": "reliable" if any(keep.reliable for keep in keeps) else "newest",
            "limit": sum(keep.limit for keep in keeps),
            "waiting": len(self.queue),
            "waiting_bytes": self.queue.heavy_bytes,
            "dropped": self.queue.dropped(),
        }


class Route(msgspec.Struct, frozen=True):
    """The readers of packets of one type and destination on one channel: an immutable snapshot, read without a lock.

    Attributes:
        queues: the queues of all components that get the packets.
        reliable: those components that may refuse a packet.
        taps: functions that see the packets besides.
    """

    queues: tuple[ChannelQueue, ...]
    reliable: tuple[Listener, ...]
    taps: tuple[Tap, ...]

    def give(self, packet: Packet, weight: int) -> None:
        """Gives a packet to all of them, or to none; `weight`: its bytes, where it is a heavy one.

        Raises:
            MailboxFull: a `reliable` subscriber has no room; no subscriber got the packet.
        """
        # All reliable readers are asked before any of them gets the packet: a retry must not double it.
        for reader in self.reliable:
            reader.refuse(packet, weight)
        for queue in self.queues:
            queue.put(packet, weight)
        for tap in self.taps:
            tap(packet)

    def give_all(self, packets: Sequence[Packet], weight: int) -> None:
        """Gives packets, where there is no tap and no reader may refuse one; `weight`: the bytes of each, if heavy."""
        for packet in packets:
            for queue in self.queues:
                queue.put(packet, weight)

    def give_where_room(self, packet: Packet, weight: int) -> None:
        """Gives a packet, which cannot come again, to all of them that have room, and counts it for the others."""
        for queue in self.queues:
            if queue.refuses(packet, weight):
                queue.refused += 1
            else:
                queue.put(packet, weight)
        for tap in self.taps:
            tap(packet)


def _names(types: Collection[str | None]) -> list[str] | None:
    """Returns the names of types, sorted; None where all types are meant."""
    return None if None in types else sorted(str(name) for name in types)
