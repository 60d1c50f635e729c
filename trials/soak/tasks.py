"""The tasks of a soak: they talk to each other, keep state and move; who runs twice is caught by a file lock."""

from __future__ import annotations

import fcntl
import gc
import os
import sys
import time
from dataclasses import dataclass
from typing import Any

from pancakes.errors import MailboxFull
from pancakes.packet import NEIGHBOURS, SYSTEM, Packet, join, packet_type
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, Tick, every, on, reliable

SWEPT_S = 2.0
"""How often rubbish is collected."""
TALK = "talk"
"""A channel of their own: of `system` only the newest waits for a peer that is slow."""
TALK_HZ = 10.0
"""So often a talker talks; before, it looks once a second whether it is to, and rests otherwise."""
PIECE_BYTES = 256
"""Size of a piece of memory that is lost on purpose."""


@packet_type("soak.beat")
@dataclass(frozen=True, slots=True)
class Beat:
    """Told to everybody, time and again."""

    count: int


@packet_type("soak.word")
@dataclass(frozen=True, slots=True)
class Word:
    """Told to one task, wherever that is."""

    count: int


@packet_type("soak.said")
@dataclass(frozen=True, slots=True)
class Said:
    """Told to one agent, with the time of the machine's clock."""

    count: int
    at_s: float


class Talker(Task):
    """Talks to one agent, from when there is a file until it is gone."""

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
        """Begins to talk, or ends, as the file says."""
        if self._talks is not os.path.exists(self.settings.while_there):
            self._talks = not self._talks
            self.reschedule(TALK_HZ if self._talks else 0.0, "talk")

    @every(hz=0)
    def talk(self, tick: Tick) -> None:
        """Says something."""
        self.state.said += 1
        self.publish(TALK, Said(self.state.said, time.monotonic()), to=join(self.settings.to, "client/Listener"))


class Listener(Task):
    """Writes down what others say: who, the count, and how long it took."""

    @dataclass
    class Settings:
        file: str = ""

    settings: Settings

    def on_start(self) -> None:
        self._file = os.open(self.settings.file, os.O_CREAT | os.O_APPEND | os.O_WRONLY)

    def on_stop(self) -> None:
        os.close(self._file)

    @on(TALK, Said, keep=reliable(1024), addressed=True)
    def hear(self, packet: Packet) -> None:
        """Somebody has said something."""
        took_s = time.monotonic() - packet.body.at_s
        os.write(self._file, f"{packet.source} {packet.body.count} {took_s:.6f}\n".encode())


class Passing(Task):
    """Comes and goes; it uses all that a task may use of an agent."""

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
        """Says that it has begun."""
        self.log("debug", f"beats at {self.settings.loudness:g}")

    @every(hz=10)
    def beat(self, tick: Tick) -> None:
        """Tells all agents."""
        self.state.beats += 1
        self.publish(SYSTEM, Beat(self.state.beats))
        if self.state.beats % 5 == 0:
            self.publish(SYSTEM, Beat(self.state.beats), to=NEIGHBOURS)
        if self.state.beats % 20 == 0:
            self.event("soak_beats", count=self.state.beats)

    @on(SYSTEM, Beat, keep="latest")
    def hear(self, packet: Packet) -> None:
        """Counts what others tell."""
        self.state.heard += 1


class Worker(TaskCore, Passing):
    """The same, but there is one of it in the whole fleet, which moves from agent to agent.

    It holds a lock while it may act, and writes a line into a file where it finds another at work.
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
        """Sends a word to another task, wherever that is."""
        try:
            self.publish(SYSTEM, Word(self.state.sent + 1), to=f"task:{self.settings.friend}")
        except MailboxFull:
            return  # too many wait for an agent that is dead: not sent, so not counted
        self.state.sent += 1

    @on(SYSTEM, Word, keep=reliable(256))
    def hear(self, packet: Packet) -> None:
        """Counts the words that it gets."""
        self.state.words += 1


class Sweeper(Task):
    """Sees to it that what grows is a leak: it has rubbish collected, and says how many pieces of memory are in use.

    By itself Python looks for it only once 10,000 objects more are alive (`pancakes.tools.cli.agent_process`): memory
    goes up and down by some 2 MiB in a quarter of an hour, and a leak would not be seen in a short run.
    """

    @dataclass
    class Settings:
        leak_bytes: int = 0
        """So much is lost on purpose with each sweep, to see that the soak finds it."""

    settings: Settings

    def on_start(self) -> None:
        self._lost: list[list[bytes]] = []

    @every(period_s=SWEPT_S)
    def sweep(self, tick: Tick) -> None:
        """Collects it."""
        gc.collect()
        if self.settings.leak_bytes:
            self._lost.append([bytes(PIECE_BYTES - 33) for _ in range(self.settings.leak_bytes // PIECE_BYTES)])
        self.event("soak_swept", pieces=sys.getallocatedblocks())


class Roamer(Task):
    """The least that can move, for fleets in virtual time."""

    @dataclass
    class State:
        ticks: int = 0

    state: State

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Counts."""
        self.state.ticks += 1
