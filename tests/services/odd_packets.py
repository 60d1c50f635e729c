"""A small fleet whose members say odd things to each other."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Final

import msgspec
from services.counting import Count
from services.odd_values import OddValues

from pancakes.control import Migrate, Shutdown, Start, Stop
from pancakes.devices import Pose
from pancakes.devices.driver import Sensor
from pancakes.errors import PancakesError
from pancakes.packet import known_types
from pancakes.testing import Fleet

NAMES: Final = ("Count", "Count", "Guarded", "Made", "g", "client", "a", "b", "a/Count", "a/Guarded", "test.Count")
ACTORS: Final = ("", "/client", "/network/TaskMigrator", "/kernel/Registrar", "/kernel/Courier", "/kernel")
ASKED: Final = (Migrate("Count"), Migrate("Guarded"), Stop("Count"), Start("Count"), Stop("Guarded"), Start("Guarded"))
AT_ONCE: Final = 80


class Still(Sensor):
    """A pose that never changes."""

    type = "pose"

    def read(self) -> Pose:
        return Pose(0.0, 0.0, 0.0)


def classes_of(*modules: str) -> list[type[msgspec.Struct]]:
    """Returns the packet types of some modules and packages."""
    return [cls for cls in known_types().values() if cls.__module__.startswith(modules) and cls is not Shutdown]


def say_odd_things(seed: int, channel: str, classes: list[type[msgspec.Struct]], actors: tuple[str, ...]) -> int:
    """Has three agents say odd things to each other while tasks start, stop and move; returns how many were sent."""
    with Fleet(seed, classes={"test.Count": Count}) as fleet:
        tasks = {"Count": {"type": "test.Count"}, "Guarded": {"type": "test.Count", "guard": {"copies": 3}}}
        a = fleet.start("a", tasks=tasks, devices={"g": {"type": Still, "rate_hz": 5}})
        agents = [a, fleet.start("b"), fleet.start("c")]
        fleet.connect()
        fleet.run_for(2.0)
        journals = [agent.agent.mesh.identity.journal for agent in agents]
        client: Any = a.component("client")
        snapshots = [place.record.snapshot for place in client.places.values()]
        odd, sent = OddValues(seed, (*NAMES, *journals), snapshots), 0
        for number in range(AT_ONCE):
            if number % 10 == 5:
                a.publish("sysctrl", odd.draw.choice(ASKED))
            body, of, agent = odd.of_class(odd.draw.choice(classes)), odd.draw.choice("abc"), odd.draw.choice(agents)
            with suppress(PancakesError):  # what cannot travel is refused at home
                for actor in actors:
                    agent.publish(channel, body, of + actor)
                sent += 1
            fleet.run_for(odd.draw.choice((0.0, 0.01, 0.2)))
        fleet.run_for(10.0)
    return sent


def say_odd_control_packets(seed: int) -> None:
    """Check that no actor of Pancakes ends because of a control packet with odd values."""
    classes = classes_of("pancakes.control")
    assert len(classes) > 20
    assert say_odd_things(seed, "sysctrl", classes, ("",)) > AT_ONCE // 2


def say_odd_messages(seed: int) -> None:
    """The same of messages between agents."""
    classes = classes_of("pancakes.durable")
    assert len(classes) > 15
    assert say_odd_things(seed, "network", classes, ACTORS) > AT_ONCE // 2
