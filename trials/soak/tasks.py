"""The tasks of a soak: they exchange packets, keep state and migrate; a file lock finds a task that runs twice."""

from __future__ import annotations

import fcntl
import gc
import os
import sys
import time
from dataclasses import dataclass
from typing import Any

from pancakes.errors import MailboxFullError
from pancakes.packet import NEIGHBOURS, SYSTEM, Packet, join, packet_type
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, Tick, every, on, reliable

SWEPT_S = 2.0
"""How often garbage is collected, in seconds."""
TALK = "talk"
"""A channel of their own: on `system`, only the newest packet waits for a slow peer."""
TALK_HZ = 10.0
"""How often a talker publishes; while it does not talk, it checks once a second whether it should."""
PIECE_BYTES = 256
"""The size of a memory block that is leaked on purpose."""


@packet_type("soak.beat")
@dataclass(frozen=True, slots=True)
class Beat:
    """A packet to everybody, published periodically."""

    count: int


@packet_type("soak.word")
@dataclass(frozen=True, slots=True)
class Word:
    """A letter to one task, on any agent."""

    count: int


@packet_type("soak.said")
@dataclass(frozen=True, slots=True)
class Said:
    """A packet to one agent, with the time of the machine's clock."""

    count: int
    at_s: float


class Talker(Task):
    """Talks to one agent as long as a file exists."""

    @dataclass
    class Settings:
        to: str = ""
        while_there: str = ""

    @dataclass
    class State:
        said: int = 0

    settings: Settings
    state: State

    def on_start(self) -> None:
        self._talks = False

    @every(hz=1)
    def look(self, tick: Tick) -> None:
        """Begin or stop to talk, if the file has appeared or disappeared."""
        if self._talks is not os.path.exists(self.settings.while_there):
            self._talks = not self._talks
            self.reschedule(TALK_HZ if self._talks else 0.0, "talk")

    @every(hz=0)
    def talk(self, tick: Tick) -> None:
        """Publish the next packet."""
        self.state.said += 1
        self.publish(TALK, Said(self.state.said, time.monotonic()), to=join(self.settings.to, "client/Listener"))


class Listener(Task):
    """Logs the packets of talkers: source, count, and travel time."""

    @dataclass
    class Settings:
        file: str = ""

    settings: Settings

    def on_start(self) -> None:
        self._file = os.open(self.settings.file, os.O_CREAT | os.O_APPEND | os.O_WRONLY)

    def on_stop(self) -> None:
        os.close(self._file)

    @on(TALK, Said, queue=reliable(1024), addressed=True)
    def hear(self, packet: Packet) -> None:
        """Log a packet."""
        took_s = time.monotonic() - packet.body.at_s
        os.write(self._file, f"{packet.source} {packet.body.count} {took_s:.6f}\n".encode())


class Passing(Task):
    """A task that is started and stopped often, and uses all features of an agent."""

    @dataclass
    class Settings:
        loudness: float = 1.0

    @dataclass
    class State:
        beats: int = 0
        heard: int = 0

    settings: Settings
    state: State

    def on_start(self) -> None:
        self.after(0.2, self.say_so)

    def say_so(self) -> None:
        """Log that the task has begun."""
        self.log("debug", f"beats at {self.settings.loudness:g}")

    @every(hz=10)
    def beat(self, tick: Tick) -> None:
        """Publish to all agents."""
        self.state.beats += 1
        self.publish(SYSTEM, Beat(self.state.beats))
        if self.state.beats % 5 == 0:
            self.publish(SYSTEM, Beat(self.state.beats), to=NEIGHBOURS)
        if self.state.beats % 20 == 0:
            self.event("soak_beats", count=self.state.beats)

    @on(SYSTEM, Beat, queue="latest")
    def hear(self, packet: Packet) -> None:
        """Count the packets of others."""
        self.state.heard += 1


class Worker(TaskCore, Passing):
    """The same as a task that exists once in the fleet and migrates from agent to agent.

    It holds a lock while it may act, and writes a line into a file if another instance already has the lock.
    """

    __module__ = "pancakes"  # its names are Pancakes' own

    @dataclass
    class Settings(Passing.Settings):
        directory: str = ""
        friend: str = ""
        state_bytes: int = 4096

    @dataclass
    class State(Passing.State):
        words: int = 0
        sent: int = 0
        load: bytes = b""

    settings: Settings
    state: State

    def on_start(self) -> None:
        if len(self.state.load) != self.settings.state_bytes:
            self.state.load = self.random.randbytes(self.settings.state_bytes)
        self._lock = os.open(os.path.join(self.settings.directory, f"{self.name}.lock"), os.O_CREAT | os.O_RDWR)
        self._take()
        super().on_start()

    def on_stop(self) -> None:
        os.close(self._lock)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self.on_stop()

    def freeze(self) -> None:
        super().freeze()
        fcntl.flock(self._lock, fcntl.LOCK_UN)

    def thaw(self) -> None:
        self._take()
        super().thaw()

    def _take(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with open(os.path.join(self.settings.directory, f"{self.name}.doubled"), "a") as out:
                out.write(f"{self.address} runs beside another\n")

    @every(hz=5)
    def tell(self, tick: Tick) -> None:
        """Send a letter to another task."""
        try:
            self.publish(SYSTEM, Word(self.state.sent + 1), to=f"task:{self.settings.friend}")
        except MailboxFullError:
            return  # too many letters wait for a dead agent: this one is not sent, so not counted
        self.state.sent += 1

    @on(SYSTEM, Word, queue=reliable(256))
    def hear(self, packet: Packet) -> None:
        """Count the letters that arrive."""
        self.state.words += 1


class Sweeper(Task):
    """Collects garbage, so that only leaks grow, and reports how many memory blocks are in use.

    By itself, Python collects only after 10,000 more objects are alive (`pancakes.tools.cli.agent_process`), so memory
    varies by some 2 MiB in a quarter of an hour, which would hide a leak in a short run.
    """

    @dataclass
    class Settings:
        leak_bytes: int = 0
        """How many bytes are leaked on purpose with each sweep, to check that the soak finds it."""

    settings: Settings

    def on_start(self) -> None:
        self._lost: list[list[bytes]] = []

    @every(period_s=SWEPT_S)
    def sweep(self, tick: Tick) -> None:
        """Collect garbage."""
        gc.collect()
        if self.settings.leak_bytes:
            self._lost.append([bytes(PIECE_BYTES - 33) for _ in range(self.settings.leak_bytes // PIECE_BYTES)])
        self.event("soak_swept", pieces=sys.getallocatedblocks())


class Roamer(Task):
    """The smallest task that can migrate, for fleets in virtual time."""

    @dataclass
    class State:
        ticks: int = 0

    state: State

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Count."""
        self.state.ticks += 1
