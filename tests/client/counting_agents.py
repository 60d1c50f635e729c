"""Two agents that run as processes, with tasks that count, answer and flood; for tests of clients."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from cli.processes import Rig, Running
from msgspec import Struct

from pancakes.packet import packet_type

SOURCE: Final = """
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Struct

from pancakes.packet import packet_type
from pancakes.task import Task, every, on


@packet_type("client.count")
class Count(Struct, frozen=True):
    number: int


@packet_type("client.word")
class Word(Struct, frozen=True):
    text: str


@packet_type("client.answer")
class Answer(Struct, frozen=True):
    text: str
    stamp_s: float


class Counting(Task):
    @dataclass
    class Settings:
        step: Annotated[int, Meta(ge=1)] = 1

    @dataclass
    class State:
        number: int = 0

    @every(hz=50)
    def tick(self, tick):
        self.state.number += self.settings.step
        self.publish("system", Count(self.state.number))


class Answering(Task):
    @on("system", Word)
    def heard(self, packet):
        self.publish("system", Answer(packet.body.text, packet.stamp_s))
        self.log("info", f"{packet.body.text} was said")


class Flooding(Task):
    @every(hz=10)
    def tick(self, tick):
        for number in range(100):
            self.publish("flood", Count(number))
"""
ENTRY_POINTS: Final = """
[pancakes.tasks]
client.Counting = plugin_counting:Counting
client.Answering = plugin_counting:Answering
client.Flooding = plugin_counting:Flooding
"""
TASKS: Final = """
[task.Counting]
type = "client.Counting"

[task.Answering]
type = "client.Answering"

[task.Flooding]
type = "client.Flooding"

[service.client.settings]
channels = ["flood"]
"""


@packet_type("client.count")
class Count(Struct, frozen=True):
    number: int


@packet_type("client.word")
class Word(Struct, frozen=True):
    text: str


@packet_type("client.answer")
class Answer(Struct, frozen=True):
    text: str
    stamp_s: float


class CountingAgents:
    """The agents `a`, which has all tasks, and `b`, which is its neighbour and has none."""

    def __init__(self, directory: Path) -> None:
        self.rig = Rig(directory)
        self.rig.install("counting", ENTRY_POINTS, SOURCE)
        self.a = self.rig.ready("a", TASKS)
        self.b = self.rig.ready("b", agent=f'peers = ["{self.rig.address(self.a)}"]')
        self.a.hear("peer_up peer=b")

    @contextmanager
    def frozen(self, agent: Running) -> Iterator[None]:
        """An agent neither runs nor ends in this block."""
        os.kill(agent.pid, signal.SIGSTOP)
        os.waitpid(agent.pid, os.WUNTRACED)
        try:
            yield
        finally:
            os.kill(agent.pid, signal.SIGCONT)
