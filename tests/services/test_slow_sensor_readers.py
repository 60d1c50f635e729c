"""A sensor and its readers: one that is slow does not end the sensor."""

from pancakes.devices import Load
from pancakes.devices.driver import Sensor
from pancakes.task import Task, on, reliable
from pancakes.testing import Fleet


class Meter(Sensor):
    """Always has something to say."""

    type = "load"

    def read(self):
        return Load(0.5)


class Slow(Task):
    """Wants every reading, and has room for two."""

    @on("system", Load, queue=reliable(2))
    def reading(self, packet):
        pass


def test_a_reliable_reader_without_room_does_not_end_a_sensor():
    with Fleet(seed=2) as fleet:
        agent = fleet.start("a", devices={"load": {"type": Meter, "rate_hz": 10}}, tasks={"Slow": Slow})
        slow = agent.task("Slow")
        slow.call(slow.pause)
        fleet.run_for(2.0)
        assert not agent.events("task_failed")
        assert len([line for line in agent.lines("warning") if "readings of load are lost" in line]) == 1
        slow.call(slow.resume)
        fleet.run_for(0.15)
        agent.probe.forget()
        fleet.run_for(1.0)
        assert len(agent.probe.packets(Load)) == 10
