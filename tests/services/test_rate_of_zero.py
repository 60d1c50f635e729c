"""A rate of 0 lets a timer rest, wherever it is said: in the class, in a file, at its creation and while it runs."""

from pancakes.control import Create, Describe, Reschedule
from pancakes.devices import Load
from pancakes.devices.driver import Sensor
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Meter(Sensor):
    type = "load"

    def read(self):
        return Load(0.5)


class Beat(Task):
    @every(hz=5)
    def beat(self, tick):
        self.event("beat")


class Rest(Task):
    @every(hz=0)
    def beat(self, tick):
        self.event("beat")


TYPES = {"test.Beat": Beat}


def test_a_rate_of_zero_rests_until_it_is_rescheduled():
    with Fleet(seed=3, classes=TYPES) as fleet:
        agent = fleet.start(
            "a",
            devices={"load": {"type": Meter, "rate_hz": 0}},
            tasks={"Filed": {"type": Beat, "rate_hz": 0}, "Said": Rest, "Ran": Beat},
        )
        assert agent.ask(Create("Made", "test.Beat", rate_hz=0)).ok
        assert agent.ask(Reschedule("Ran", 0)).ok
        agent.probe.forget()
        fleet.run_for(2.0)
        assert not agent.events("beat") and not agent.probe.packets(Load)

        tables = agent.ask(Describe(config=True)).result["config"]
        assert tables["task"]["Made"]["rate_hz"] == tables["device"]["load"]["rate_hz"] == 0

        for name in ("Filed", "Said", "Made", "Ran", "device/load"):
            assert agent.ask(Reschedule(name, 10)).ok
        agent.probe.forget()
        fleet.run_for(1.0)
        assert len(agent.events("beat")) >= 36 and len(agent.probe.packets(Load)) >= 9
