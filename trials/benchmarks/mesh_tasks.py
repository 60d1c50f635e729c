"""The tasks of the benchmarks that run in agents of their own."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass

import msgspec

from pancakes.errors import MailboxFull
from pancakes.packet import Packet, packet_type
from pancakes.task import Task, Tick, every, on, queue

WINDOW = 16_384
WINDOW_BYTES = 4 * 1024 * 1024
"""Most packets on their way one way, and most bytes; the receiver acknowledges each quarter of that.

With a quarter as many, the acknowledgements would disturb the sender so often that a twelfth less went through.
"""
BURST = 256
"""Packets published in one turn, which takes 0.3 ms. With 64 a tenth less goes through, for the system calls."""
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

    @on("load", Load, keep=queue(2 * WINDOW))
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
            except MailboxFull:
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
