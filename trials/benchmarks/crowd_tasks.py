"""The task of the benchmarks in which many agents send at once."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from typing import Any

import msgspec
from benchmarks.mesh_tasks import BURST, Got, Load

from pancakes.errors import MailboxFull
from pancakes.events import Event
from pancakes.packet import NEIGHBOURS, Packet, packet_type
from pancakes.task import Task, Tick, every, on, queue

CROWD_WINDOW = 1024
"""Most packets of a sender on their way to any one receiver.

As many may wait for a slow peer on one channel; so none that goes to all neighbours is ever left out.
"""
ACKNOWLEDGED = CROWD_WINDOW // 4
"""A receiver acknowledges so many packets at once."""
MOST_SENDERS = 8


@packet_type("bench.here")
class Here(msgspec.Struct, frozen=True):
    """Says how many others the sender has heard of."""

    seen: int


@packet_type("bench.now")
class Now(msgspec.Struct, frozen=True):
    """Everybody sees everybody: the senders begin."""


class Member(Task):
    """Waits until everybody is there, sends its packets to all that are named, and takes those of the others.

    Reports on a file descriptor when it began, when it had handled the last packet (both in seconds of the machine's
    monotonic clock), how much processor time that took in its process, and what it lost.
    """

    @dataclass
    class Settings:
        report_fd: int
        members: int
        packets: int
        size: int = 64
        leads: bool = False
        to: list[str] = field(default_factory=list)
        """Where its packets go, one after the other: agents, or `*`."""
        receivers: list[str] = field(default_factory=list)
        """The agents that get them."""
        senders: list[str] = field(default_factory=list)
        """The agents whose packets it gets."""

    def on_start(self) -> None:
        settings = self.settings
        self.data = bytes(settings.size)
        self.packets = settings.packets
        self.seen = {self.agent: 1}
        self.is_running = self.is_done = False
        self.sent = 0
        self.to_send = settings.packets * len(settings.to)
        self.acknowledged = dict.fromkeys(settings.receivers, 0)
        self.slowest = 0
        self.next = dict.fromkeys((f"{sender}/client/Member" for sender in settings.senders), 0)
        self.unfinished = len(self.next)
        self.lost = 0
        self.began_s = self.ended_s = 0.0

    @every(hz=20)
    def knock(self, tick: Tick) -> None:
        """Tells the others whom it sees, until everybody sees everybody."""
        self.publish("bench", Here(len(self.seen)), to=NEIGHBOURS)

    @on("bench", Here)
    def heard(self, packet: Packet) -> None:
        """Another one is there."""
        self.seen[packet.source.partition("/")[0]] = packet.body.seen
        self.seen[self.agent] = members = len(self.seen)
        if self.settings.leads and not self.is_running and members == self.settings.members:
            if all(seen == members for seen in self.seen.values()):
                self.publish("bench", Now(), to=NEIGHBOURS)
                self.begin()

    @on("bench", Now)
    def begin_with_others(self, packet: Packet) -> None:
        """The leader says that everybody is there."""
        self.begin()

    def begin(self) -> None:
        """Sends from now on."""
        self.is_running = True
        self.reschedule(0)
        self.began_s = time.monotonic()
        self.began_cpu_s = time.process_time()
        if self.to_send:
            self.flood()

    def flood(self) -> None:
        """Publishes a burst, if there is room in the windows."""
        to, data, publish = self.settings.to, self.data, self.publish
        room = (self.slowest + CROWD_WINDOW) * len(to) - self.sent
        last = self.sent + min(BURST, self.to_send - self.sent, room)
        number, place = divmod(self.sent, len(to))
        while self.sent < last:
            try:
                publish("load", Load(number, data), to=to[place])
            except MailboxFull:
                self.after_host(0.001, self.flood)
                return
            self.sent += 1
            place += 1
            if place == len(to):
                number, place = number + 1, 0
        if self.sent < self.to_send and room > BURST:
            self.call(self.flood)

    @on("load", Load, keep=queue(2 * MOST_SENDERS * CROWD_WINDOW))
    def take(self, packet: Packet) -> None:
        """Counts one packet of another member."""
        source, count = packet.source, packet.body.number + 1
        expected = self.next[source]
        self.next[source] = count
        if count != expected + 1 or not count % ACKNOWLEDGED or count == self.packets:
            self.acknowledge(source, expected, count)

    def acknowledge(self, source: str, expected: int, count: int) -> None:
        """Tells another member that it has `count` of its packets, where so many more have come, or one was lost."""
        self.lost += count - 1 - expected
        is_last = count == self.packets
        if is_last or count // ACKNOWLEDGED > expected // ACKNOWLEDGED:
            self.publish("bench", Got(count), to=source)
        if is_last:
            self.unfinished -= 1
            self.finish()

    @on("bench", Got)
    def go_on(self, packet: Packet) -> None:
        """A receiver has so many."""
        was_full = self.sent == (self.slowest + CROWD_WINDOW) * len(self.settings.to)
        self.acknowledged[packet.source.partition("/")[0]] = packet.body.count
        self.slowest = min(self.acknowledged.values())
        if self.slowest == self.settings.packets:
            self.finish()
        elif was_full:
            self.flood()

    @on("log", Event)
    def heard_of(self, packet: Packet) -> None:
        """A link that breaks in the middle, on a machine that is too busy for example, takes packets with it."""
        event = packet.body
        if event.kind == "peer_down" and self.is_running and not self.is_done:
            self.report({"fault": f"{self.agent} lost its link to {event.fields['peer']}: {event.fields['reason']}"})

    def finish(self) -> None:
        """Reports, once it has sent all and got all."""
        if not self.unfinished and not self.ended_s:
            self.ended_s = time.monotonic()
            self.cpu_s = time.process_time() - self.began_cpu_s
        if self.unfinished or (self.acknowledged and self.slowest < self.settings.packets):
            return
        received = sum(self.next.values()) - self.lost
        times_s = {"began_s": self.began_s, "ended_s": self.ended_s, "cpu_s": self.cpu_s}
        self.report({**times_s, "received": received, "lost": self.lost})

    def report(self, values: dict[str, Any]) -> None:
        """Tells whoever started the agent, once."""
        if not self.is_done:
            self.is_done = True
            os.write(self.settings.report_fd, f"{json.dumps(values)}\n".encode())
