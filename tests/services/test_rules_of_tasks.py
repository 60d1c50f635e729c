"""Rules by which tasks move by themselves, where an agent has several."""

from pancakes.bodies.devices.types import Battery
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.task import Task
from pancakes.testing import FleetInTest


class Plain(Task):
    """Does nothing."""


class Other(Plain):
    """Likewise."""


def test_a_reading_is_compared_with_the_rules_about_its_type_alone():
    """Both rules look at a field of the same name."""
    about_load = {"type": Plain, "migrate": {"when": "load", "field": "level", "below": 0.65}}
    about_battery = {"type": Other, "migrate": {"when": "battery", "below": 0.3}}
    with FleetInTest(3) as fleet:
        a = fleet.start("a", tasks={"Plain": about_load, "Other": about_battery})
        fleet.start("b")
        fleet.connect()
        a.publish("system", Battery(11.0, 0.5))
        fleet.run_for(2.0)
        assert a.events("migration_asked") == []
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(2.0)
        assert [event["task"] for event in a.events("migration_asked")] == ["Other"]


def test_the_reading_of_another_agent_moves_no_task():
    with FleetInTest(3) as fleet:
        a = fleet.start("a", tasks={"Other": {"type": Other, "migrate": {"when": "battery", "below": 0.3}}})
        b = fleet.start("b")
        fleet.connect()
        heard: list[Packet] = []
        a.kernel.stream.tap("system", heard.append, ("battery",))
        b.publish("system", Battery(11.0, 0.2), to=NEIGHBOURS)
        fleet.run_for(2.0)
        assert [packet.source.split("/")[0] for packet in heard] == ["b"]
        assert a.events("migration_asked") == []
