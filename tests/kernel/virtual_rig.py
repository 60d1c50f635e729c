"""A kernel in virtual time, and an actor that writes down what happens to it, for tests of components."""

from dataclasses import dataclass

from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import on
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.packet import packet_type
from pancakes.testing import Probe


@packet_type("virtual_rig.number")
@dataclass(frozen=True)
class Number:
    """A packet of these tests."""

    n: int


@packet_type("virtual_rig.word")
@dataclass(frozen=True)
class Word:
    """Another."""

    text: str


class VirtualRig:
    """A kernel in virtual time, with a source of packets."""

    def __init__(self, seed=1, **others):
        self.dispatcher = VirtualDispatcher(seed)
        self.kernel = Kernel("a", virtual=self.dispatcher, **others)
        self.source = self.spawn(ActorCore, "a/client/Source")
        self.probe = self.spawn(Probe, "a/test/Probe", channels=("log",))

    def spawn(self, cls, address, **arguments):
        component = self.kernel.spawn(cls, address, **arguments)
        self.settle()
        return component

    def send(self, *bodies, to="", channel="system"):
        for body in bodies:
            self.source.publish(channel, body, to)

    def settle(self):
        self.dispatcher.settle()

    def run_until(self, time_s):
        self.dispatcher.run_until(time_s)

    def lines(self):
        self.settle()
        return [packet.body.text for packet in self.probe.packets(LogLine)]


class Diary(ActorCore):
    """Writes down what happens to it."""

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self.diary = []

    def on_start(self):
        self.diary.append("start")

    def on_stop(self):
        self.diary.append("stop")

    @on("system", Number)
    def number(self, packet):
        self.diary.append(packet.body.n)
