"""Tasks that tell the time, and that hear it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pancakes.kernel.actor import core_of
from pancakes.packet import Packet, packet_type
from pancakes.task import Task, Tick, every, on


@packet_type("test.pulse")
@dataclass(frozen=True)
class PulseTold:
    """A pulse.

    Attributes:
        true_s: when it was told, in virtual time.
    """

    true_s: float


def true_s(task: Task) -> float:
    """Returns the virtual time, which no task knows by itself."""
    virtual = core_of(task).kernel.virtual
    assert virtual is not None
    return virtual.clock.now()


class PulseTeller(Task):
    """Tells all neighbours a pulse ten times a second."""

    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        self.publish("network", PulseTold(true_s(self)), to="*")


class PulseReader(Task):
    """Hears pulses, and says of each when it was."""

    def on_start(self) -> None:
        self.heard: list[Any] = []

    @on("network", PulseTold, queue=256)
    def on_pulse(self, packet: Packet) -> None:
        self.heard.append((self.now(), true_s(self), packet, self.local_time(packet), packet.age_s))
