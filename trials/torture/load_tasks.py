"""Tasks that load agents, and tasks that measure the effect on others. Agents find them by entry point.

Each writes its reports to a file of its own, as lines of JSON, with times of the clock that all processes of a machine
share. The file is the setting `file`.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from typing import Any

from pancakes.control import Describe, Reply
from pancakes.errors import LocalProtocolError, MailboxFullError
from pancakes.packet import Packet, packet_type
from pancakes.task import Task, Tick, every, on, reliable

REPORT_HZ = 10


@packet_type("load.blob")
@dataclass(frozen=True)
class Blob:
    """One of many packets, numbered together with the marks of the same source."""

    number: int
    data: bytes


@packet_type("load.mark")
@dataclass(frozen=True)
class Mark:
    """Another type on the same channel, of a fixed size."""

    number: int


@packet_type("load.ping")
@dataclass(frozen=True)
class Ping:
    """A request for a `Pong`, with its time."""

    sent_s: float


@packet_type("load.pong")
@dataclass(frozen=True)
class Pong:
    """The answer to a `Ping`."""

    sent_s: float


class Telling(Task):
    """Writes reports into its file."""

    @dataclass
    class Settings:
        file: str = ""

    def on_start(self) -> None:
        self.out = os.open(self.settings.file, os.O_CREAT | os.O_WRONLY | os.O_APPEND)

    def on_stop(self) -> None:
        os.close(self.out)

    def tell(self, **figures: Any) -> None:
        """Add a line."""
        os.write(self.out, (json.dumps({"at_s": time.monotonic(), **figures}) + "\n").encode())


class Flood(Telling):
    """Publishes a number of blobs per second, whether they are handled or not; one in eight packets is a mark."""

    @dataclass
    class Settings:
        file: str = ""
        to: str = ""
        channel: str = "load"
        size: int = 64
        per_s: float = 0.0
        """The rate of packets per second; 0: none."""

    def on_start(self) -> None:
        super().on_start()
        self.number = self.refused = self.too_large = 0
        self.owed = 0.0

    @every(hz=200)
    def pour(self, tick: Tick) -> None:
        """Publish the packets that are due. A refused packet is published again with its number in the next tick."""
        settings = self.settings
        self.owed = min(self.owed + settings.per_s / 200 * (1 + tick.missed), max(1.0, settings.per_s / 50))
        while self.owed >= 1:
            self.owed -= 1
            number = self.number + 1
            try:
                body = Mark(number) if number % 8 == 0 else Blob(number, bytes(settings.size))
                self.publish(settings.channel, body, to=settings.to)
            except MailboxFullError:
                self.refused += 1
                return
            except LocalProtocolError:
                self.too_large += 1
            self.number = number

    @every(hz=REPORT_HZ)
    def report(self, tick: Tick) -> None:
        """Tell how far it is."""
        self.tell(published=self.number, refused=self.refused, too_large=self.too_large)


class Reader(Telling):
    """Handles blobs and marks, computes for `work_s` on each, and checks their order."""

    @dataclass
    class Settings:
        file: str = ""
        work_s: float = 0.0

    def on_start(self) -> None:
        super().on_start()
        self.last: dict[str, int] = {}
        self.handled = self.disordered = self.doubled = 0

    def take(self, packet: Packet) -> None:
        """Handle one packet."""
        number, last = packet.body.number, self.last.get(packet.source, 0)
        self.doubled += number == last
        self.disordered += number < last
        self.last[packet.source] = number
        self.handled += 1
        until_s = time.perf_counter() + self.settings.work_s
        while time.perf_counter() < until_s:
            pass

    @every(hz=REPORT_HZ)
    def report(self, tick: Tick) -> None:
        """Tell how far it is."""
        self.tell(handled=self.handled, disordered=self.disordered, doubled=self.doubled, last=sum(self.last.values()))


class QueueReader(Reader):
    """A reader with queues of 256 for each type."""

    @on("load", Blob, queue=256)
    def on_blob(self, packet: Packet) -> None:
        """Take a blob."""
        self.take(packet)

    @on("load", Mark, queue=256)
    def on_mark(self, packet: Packet) -> None:
        """Take a mark."""
        self.take(packet)


class ReliableReader(Reader):
    """A reader with reliable queues: if there is no room, the publisher gets an error."""

    @on("load", Blob, queue=reliable(256))
    def on_blob(self, packet: Packet) -> None:
        """Take a blob."""
        self.take(packet)

    @on("load", Mark, queue=reliable(256))
    def on_mark(self, packet: Packet) -> None:
        """Take a mark."""
        self.take(packet)


class SystemReader(Reader):
    """Reads what other agents publish on `system`."""

    @on("system", Blob, queue=256)
    def on_blob(self, packet: Packet) -> None:
        """Take a blob."""
        self.take(packet)

    @on("system", Mark, queue=256)
    def on_mark(self, packet: Packet) -> None:
        """Take a mark."""
        self.take(packet)


class Pulse(Telling):
    """Ticks, and reports the lateness."""

    def on_start(self) -> None:
        super().on_start()
        self.late_s: list[float] = []

    @every(hz=100)
    def beat(self, tick: Tick) -> None:
        """Record the lateness."""
        self.late_s.append(tick.lateness_s)
        if len(self.late_s) == 10:
            self.tell(late_s=self.late_s)
            self.late_s = []


class Asker(Telling):
    """Sends control packets to another agent, and reports how long each reply took."""

    @dataclass
    class Settings:
        file: str = ""
        to: str = ""

    def on_start(self) -> None:
        super().on_start()
        self.asked: dict[int, float] = {}

    @every(hz=20)
    def ask_now(self, tick: Tick) -> None:
        """Ask for a description of the other agent's `Pulse`."""
        try:
            packet = self.publish("sysctrl", Describe("client/Pulse"), to=self.settings.to)
        except MailboxFullError:
            self.tell(refused=True)
            return
        self.asked[packet.seq] = time.monotonic()

    @on("sysctrl", Reply, addressed=True)
    def on_reply(self, packet: Packet) -> None:
        """Take the answer."""
        asked_s = self.asked.pop(packet.cause[1], None) if packet.cause is not None else None
        if asked_s is not None:
            self.tell(asked_s=asked_s, took_s=time.monotonic() - asked_s)


class Pinger(Telling):
    """Sends pings to a task on another agent, and reports how long each round trip took."""

    @dataclass
    class Settings:
        file: str = ""
        to: str = ""

    @every(hz=200)
    def ping(self, tick: Tick) -> None:
        """Send a ping."""
        try:
            self.publish("load", Ping(time.monotonic()), to=self.settings.to)
        except MailboxFullError:
            self.tell(refused=True)

    @on("load", Pong, addressed=True)
    def on_pong(self, packet: Packet) -> None:
        """Take the answer."""
        self.tell(took_s=time.monotonic() - packet.body.sent_s)


class Ponger(Task):
    """Answers pings."""

    @on("load", Ping)
    def on_ping(self, packet: Packet) -> None:
        """Answer a ping."""
        self.publish("load", Pong(packet.body.sent_s), to=packet.source)
