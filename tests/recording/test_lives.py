"""An agent that begins again counts its packets from the start: what was said before is never taken for what is now."""

import pytest

from pancakes.control import Start
from pancakes.devices import Load
from pancakes.packet import NEIGHBOURS
from pancakes.recording.causal_chains import CommandChains
from pancakes.recording.reader import RecordingReader
from pancakes.task import Task, every, on
from pancakes.testing import Fleet


class Sense(Task):
    """Say ten times a second what it reads."""

    @every(hz=10)
    def read(self, tick):
        self.publish("system", Load(0.5), to=NEIGHBOURS)
        self.publish("system", Load(0.5))


class React(Task):
    """Commands an actuator at each reading."""

    @on("system", Load)
    def heard(self, packet):
        self.publish("ctrl", Load(packet.body.cpu))


@pytest.fixture
def fleet():
    with Fleet() as fleet:
        yield fleet


def lives_recorded(fleet, folder, *, keeps_its_disk=True):
    """Records `a`, which senses and reacts, and `b`, which reacts to `a` as well; `a` begins again in between."""
    a = fleet.start("a", tasks={"Sense": Sense, "React": React})
    b = fleet.start("b", tasks={"React": React})
    fleet.connect()
    for agent in (a, b):
        assert agent.ask(Start("log/Recorder", {"path": str(folder / "{agent}.mcap")})).ok
    fleet.run_for(3.0)
    fleet.stop("a")
    if not keeps_its_disk:
        fleet.disk("a").clear()
    fleet.run_for(2.0)
    a = fleet.restart("a")
    if not keeps_its_disk:  # else the recording goes on by itself
        assert a.ask(Start("log/Recorder", {"path": str(folder / "{agent}-again.mcap")})).ok
    fleet.run_for(3.0)
    fleet.stop("a")
    fleet.stop("b")
    return RecordingReader(folder)


@pytest.mark.parametrize("keeps_its_disk", [True, False])
def test_causes_join_no_readings_of_an_earlier_life(fleet, tmp_path, keeps_its_disk):
    chains = CommandChains()
    reader = lives_recorded(fleet, tmp_path, keeps_its_disk=keeps_its_disk)
    commands = [command for entry in reader.entries() for command in chains.add(entry)] + chains.close()
    for agent in "ab":
        of_agent = [command for command in commands if command.agent == agent and command.caused]
        assert len(of_agent) > 40
        assert max(command.chain.latency_s for command in of_agent) < 0.1
