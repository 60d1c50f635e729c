"""Write a service: a part of an agent that does not move, and that serves its tasks.

This one hands out work. A task asks it by a packet, and gets an answer that is addressed to the task.

$ python examples/service.py
jobs has 1 jobs left
Worker got 'sweep the hall'
jobs has 0 jobs left
Worker got 'water the plants'
"""

from dataclasses import dataclass, field

from msgspec import Struct

from pancakes import SYSTEM, Packet, Service, Simulation, Task, Tick, every, on, packet_type


@packet_type("example.idle")
class Idle(Struct, frozen=True):
    """The sender has nothing to do."""


@packet_type("example.job")
class Job(Struct, frozen=True):
    """What to do."""

    text: str


class Jobs(Service):
    @dataclass
    class Settings:
        jobs: list[str] = field(default_factory=list)

    settings: Settings

    def on_start(self) -> None:
        self.left = list(self.settings.jobs)

    @on(SYSTEM)
    def asked(self, idle: Idle, packet: Packet[Idle]) -> None:
        if self.left:
            self.publish(SYSTEM, Job(self.left.pop(0)), to=packet.source)
            print(f"{self.name} has {len(self.left)} jobs left")


class Worker(Task):
    @every(hz=1)
    def report(self, tick: Tick) -> None:
        self.publish(SYSTEM, Idle())

    @on(SYSTEM, addressed=True)
    def told(self, job: Job) -> None:
        print(f"{self.name} got {job.text!r}")


with Simulation() as simulation:
    jobs = {"type": Jobs, "settings": {"jobs": ["sweep the hall", "water the plants"]}}
    simulation.add("robot1", tasks={"Worker": Worker}, services={"jobs": jobs})
    simulation.reset(seed=1)
    simulation.step(5.0)
