"""A task that sends numbers to another, which remembers them."""

from dataclasses import dataclass, field
from typing import Any

from pancakes.errors import MailboxFullError
from pancakes.packet import packet_type, task_address
from pancakes.task import Task, every, on

HOSTS = ("a", "b", "c")
SINK = task_address("a/Sink")


@packet_type("test.numbered")
@dataclass(frozen=True)
class Numbered:
    n: Any


class Sink(Task):
    """Remembers each number that it is sent."""

    @dataclass
    class State:
        numbers: list[int] = field(default_factory=list)

    @on("system", Numbered)
    def take(self, packet):
        self.state.numbers.append(packet.body.n)


class Picky(Sink):
    """Fails on a 3."""

    @on("system", Numbered, addressed=True)
    def look(self, packet):
        if packet.body.n == 3:
            raise RuntimeError("not a three")


class Moody(Sink):
    """Fails on a number that a test chooses."""

    bad = 0

    @on("system", Numbered)
    def take(self, packet):
        if packet.body.n == self.bad:
            raise RuntimeError("not now")
        self.state.numbers.append(packet.body.n)


class Source(Task):
    """Sends one number after the other."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=50)
    def send(self, tick):
        try:
            self.publish("system", Numbered(self.state.n + 1), to=SINK)
        except MailboxFullError:
            return
        self.state.n += 1


def numbers(fleet, task="Sink"):
    """What the one copy of the task that runs has in its state."""
    for agent in fleet.agents.values():
        component = agent.component(f"client/{task}")
        if component is not None and not component.is_frozen:
            return component.facade.state.numbers
    return None


def sent_by(agent):
    """Returns how many numbers the source has sent that was stopped on an agent."""
    carried = agent.slot("Source").carried
    return carried.state["n"] if carried is not None else 0


def upto(n):
    return list(range(1, n + 1))


def fails():
    raise RuntimeError("a fault")
