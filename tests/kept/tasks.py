"""The tasks that the kept data are of. Do not change what they do: what was kept earlier was made by them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pancakes.devices import Pose, Twist
from pancakes.errors import MailboxFullError
from pancakes.packet import Packet, packet_type, task_address
from pancakes.task import Task, Tick, every, on

RECEIVER = task_address("a/Receiver")


@packet_type("kept.numbered")
@dataclass(frozen=True)
class Numbered:
    """A number that tells which letter it is."""

    n: int


class Count(Task):
    """Counts its ticks, and has a value of each kind in its state."""

    @dataclass
    class Settings:
        step: int = 1
        label: str = "plain"
        weights: dict[str, float] = field(default_factory=dict)

    @dataclass
    class State:
        n: int = 0
        label: str = ""
        raw: bytes = b""
        newest: list[int] = field(default_factory=list)
        grid: np.ndarray = field(default_factory=lambda: np.zeros(0))

    settings: Settings
    state: State

    @every(hz=10)
    def count(self, tick: Tick) -> None:
        state = self.state
        state.n += self.settings.step
        state.label = f"{self.settings.label} {state.n}"
        state.raw = state.n.to_bytes(4, "big")
        state.newest = [*state.newest[-2:], state.n]
        state.grid = np.arange(6.0).reshape(2, 3) + state.n


class Drive(Task):
    """Answers each pose with a command for the wheels."""

    requires = ("motors",)

    @dataclass
    class Settings:
        gain: float = 1.0

    @dataclass
    class State:
        commands: int = 0

    settings: Settings
    state: State

    @on("system", Pose)
    def steer(self, packet: Packet) -> None:
        self.state.commands += 1
        self.publish("ctrl", Twist(self.settings.gain * packet.body.x_m, 0.01 * self.state.commands))


class Sender(Task):
    """Sends one letter after the other to the task `a/Receiver`, at most 20 of them."""

    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=10)
    def send(self, tick: Tick) -> None:
        if self.state.n == 20:
            return
        try:
            self.publish("system", Numbered(self.state.n + 1), to=RECEIVER)
        except MailboxFullError:
            return
        self.state.n += 1


class Receiver(Task):
    """Remembers the numbers of the letters that it gets."""

    @dataclass
    class State:
        numbers: list[int] = field(default_factory=list)

    state: State

    @on("system", Numbered)
    def take(self, packet: Packet) -> None:
        self.state.numbers.append(packet.body.n)
