"""The tasks of the benchmarks in which agents speak over the mesh: two of them, or many at once.

Agents import it, so it imports nothing of the benchmarks.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from typing import Any

import msgspec

from pancakes.errors import MailboxFullError
from pancakes.events import Event
from pancakes.packet import NEIGHBOURS, Packet, packet_type
from pancakes.task import Task, Tick, every, on

WINDOW = 16_384
WINDOW_BYTES = 4 * 1024 * 1024
"""Most packets on their way one way, and most bytes; the receiver acknowledges each quarter of that.

With a quarter as many, the acknowledgements would disturb the sender so often that a twelfth less went through.
"""
BURST = 256
"""Packets published in one turn, which takes 0.3 ms. With 64 a tenth less goes through, for the system calls."""
CROWD_WINDOW = 1024
"""Most packets of a sender on their way to any one receiver.

As many may wait for a slow peer on one channel; so none that goes to all neighbours is ever left out.
"""
ACKNOWLEDGED = CROWD_WINDOW // 4
"""A receiver acknowledges so many packets at once."""
MOST_SENDERS = 8
FAR = "far/client/Far"


@packet_type("bench.ping")
class Ping(msgspec.Struct, frozen=True):
    """Asks for a `Pong`."""

    number: int
    data: bytes


@packet_type("bench.pong")
class Pong(msgspec.Struct, frozen=True):
    """Answers a `Ping`."""

    number: int
    data: bytes


@packet_type("bench.load")
class Load(msgspec.Struct, frozen=True):
    """One of many that go one way."""

    number: int
    data: bytes


@packet_type("bench.got")
class Got(msgspec.Struct, frozen=True):
    """How many have arrived, whether the last one was among them, and the receiver's processor time since the first."""

    count: int
    is_all: bool = False
    cpu_s: float = 0.0


def window_of(size: int) -> int:
    """Returns how many packets of so many bytes of data may be on their way."""
    return min(WINDOW, WINDOW_BYTES // size)


class Far(Task):
    """Answers each ping, and counts what comes one way."""

    def on_start(self) -> None:
        self.count = 0
        self.acknowledged_at = 1
        self.began_cpu_s = 0.0

    @on("bench", Ping)
    def answer(self, packet: Packet) -> None:
        """Sends a ping back."""
        self.publish("bench", Pong(packet.body.number, packet.body.data), to=packet.source)

    @on("load", Load, queue=2 * WINDOW)
    def take(self, packet: Packet) -> None:
        """Counts one packet."""
        self.count = count = self.count + 1
        body = packet.body
        if count == self.acknowledged_at or body.number < 0:
            self.acknowledged_at = count + window_of(len(body.data)) // 4
            if count == 1:
                self.began_cpu_s = time.process_time()
            used_s = time.process_time() - self.began_cpu_s
            self.publish("bench", Got(count, body.number < 0, used_s), to=packet.source)


class Near(Task):
    """Measures round trips, then packets one way; reports on a file descriptor."""

    @dataclass
    class Settings:
        report_fd: int
        round_trips: int
        packets: int
        size: int = 64

    def on_start(self) -> None:
        self.times_s: list[float] = []
        self.data = bytes(self.settings.size)
        self.asked_s = 0.0
        self.is_answered = False
        self.sent = self.got = 0
        self.window = window_of(self.settings.size)

    @every(hz=20)
    def knock(self, tick: Tick) -> None:
        """Asks until somebody is there."""
        if not self.is_answered:
            self.publish("bench", Ping(-1, self.data), to=FAR)

    @on("bench", Pong)
    def answered(self, packet: Packet) -> None:
        """Takes one answer, and asks again."""
        number = packet.body.number
        if number >= 0:
            self.times_s.append(time.perf_counter() - self.asked_s)
        elif self.is_answered:
            return
        else:
            self.is_answered = True
            self.reschedule(0)
        if number + 1 < self.settings.round_trips:
            self.asked_s = time.perf_counter()
            self.publish("bench", Ping(number + 1, self.data), to=FAR)
        else:
            self.began_s, self.began_cpu_s = time.perf_counter(), time.process_time()
            self.flood()

    def flood(self) -> None:
        """Publishes a burst, if there is room in the window."""
        publish, data = self.publish, self.data
        packets = self.settings.packets
        room = min(BURST, packets - self.sent, self.window - (self.sent - self.got))
        for number in range(self.sent, self.sent + room):
            try:
                publish("load", Load(number if number + 1 < packets else -1, data), to=FAR)
            except MailboxFullError:
                self.sent = number
                self.after_host(0.001, self.flood)
                return
        self.sent += room
        if self.sent < packets and self.sent - self.got < self.window:
            self.call(self.flood)

    @on("bench", Got)
    def go_on(self, packet: Packet) -> None:
        """More is on its way no longer."""
        was_full = self.sent - self.got >= self.window
        self.got = packet.body.count
        if packet.body.is_all:
            self.report(time.perf_counter() - self.began_s, packet.body.cpu_s)
        elif was_full:
            self.flood()

    def report(self, took_s: float, far_cpu_s: float) -> None:
        """Tells whoever started the agent."""
        packets = self.settings.packets
        cpu_us = [used_s / packets * 1e6 for used_s in (time.process_time() - self.began_cpu_s, far_cpu_s)]
        report = {"times_s": self.times_s, "per_s": packets / took_s, "received": self.got, "cpu_us": cpu_us}
        os.write(self.settings.report_fd, f"{json.dumps(report)}\n".encode())


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
            except MailboxFullError:
                self.after_host(0.001, self.flood)
                return
            self.sent += 1
            place += 1
            if place == len(to):
                number, place = number + 1, 0
        if self.sent < self.to_send and room > BURST:
            self.call(self.flood)

    @on("load", Load, queue=2 * MOST_SENDERS * CROWD_WINDOW)
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
