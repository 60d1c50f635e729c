"""A probe: it listens, remembers, and can be waited for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from pancakes.packet import Packet, type_name
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.handlers import Subscription
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.mailbox import Mailbox

KEEP = queue(1_000_000)
LOOK_S = 0.02
"""How often, in host time, a wait on threads looks at its condition where no packet comes."""

BodyTest = Callable[[Any], bool]
"""Says of a packet's body whether it is the one that is meant."""


class Probe(Component):
    """An actor that listens to channels and remembers every packet in the order in which it came.

    What it remembers may be asked for from any thread, and it may publish from any thread.

    Args:
        kernel: the kernel that it belongs to.
        address: its address.
        mailbox: None for one of its own.
        channels: what to listen to; the default are all channels, those too that are opened later.
    """

    def __init__(
        self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, *, channels: tuple[str, ...] = ()
    ) -> None:
        super().__init__(kernel, address, mailbox)
        self._channels = channels
        self._news = threading.Condition()
        self._heard: list[Packet] = []
        self._listens = False
        self._followed: set[str] = set()

    def on_start(self) -> None:
        for channel in self._channels:
            self.follow(channel)
        if not self._channels:
            self.kernel.stream.each_channel(self.follow)
        with self._news:
            self._listens = True
            self._news.notify_all()

    def listening(self) -> bool:
        """Returns whether it has started: whatever is published from then on, it hears."""
        return self._listens

    def follow(self, channel: str) -> None:
        """Listens to one more channel. Any thread."""
        with self._news:
            known = channel in self._followed
            self._followed.add(channel)
        if known:  # it was closed, and is there again
            self.kernel.stream.subscribe(self.address, self.actor_inbox, Subscription(channel, None, KEEP))
        else:
            self.subscribe(channel, None, self._hear, keep=KEEP)

    def _hear(self, packet: Packet) -> None:
        with self._news:
            self._heard.append(packet)
            self._news.notify_all()

    def packets(
        self, body: type | None = None, where: BodyTest | None = None, *, channel: str = "", source: str = ""
    ) -> list[Packet]:
        """Returns what has been heard so far.

        Args:
            body: only packets of this type.
            where: only those whose body it says yes to.
            channel: only those on this channel.
            source: only those of this publisher.
        """
        name = type_name(body) if body is not None else ""
        with self._news:
            heard = list(self._heard)
        return [
            packet
            for packet in heard
            if (not name or packet.type == name)
            and (not channel or packet.channel == channel)
            and (not source or packet.source == source)
            and (where is None or where(packet.body))
        ]

    def forget(self) -> None:
        """Forgets what has been heard so far."""
        with self._news:
            self._heard.clear()

    def wait(self, condition: Callable[[], bool], at_most_s: float) -> bool:
        """Waits until a condition is true; not to be called from an actor.

        In virtual time it runs all actors meanwhile. On threads it looks at the condition with each packet, and every
        now and then.

        Args:
            condition: is called in this thread.
            at_most_s: how long to wait: virtual seconds, or seconds of the host.

        Returns:
            Whether it became true in time.
        """
        virtual = self.kernel.virtual
        if virtual is not None:
            return virtual.run_while(lambda: not condition(), virtual.clock.now() + at_most_s)
        host = self.kernel.host
        until_s = host.now() + at_most_s
        with self._news:
            while not condition():
                left_s = until_s - host.now()
                if left_s <= 0.0:
                    return False
                self._news.wait(min(left_s, LOOK_S))
        return True
