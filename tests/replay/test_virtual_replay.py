"""Feeding a recording into agents in virtual time."""

from dataclasses import dataclass

import pytest
from replay.runs_again import recorded

from pancakes.config import parse
from pancakes.devices import Load, Pose
from pancakes.devices.driver import Sensor
from pancakes.errors import ConfigError
from pancakes.recording.reader import RecordingReader
from pancakes.simulation.fleet import registered
from pancakes.task import Task, on
from pancakes.testing import Fleet
from pancakes.tools.replay.replay import Selection, tally_of
from pancakes.tools.replay.virtual_replay import VirtualReplay

CONFIG = """
schema = 1
[agent]
name = "a"
listen = "tcp://127.0.0.1:7400"
[clock]
hold = true
speed = 4.0
[device.pose]
driver = "null.pose"
[task.Follow]
type = "test.Follow"
"""


class Walk(Sensor):
    """A pose that moves."""

    type = "pose"

    def read(self):
        return Pose(round(self.context.now(), 3), 0.0, 0.0)


class Follow(Task):
    """Answers its own robot's poses."""

    requires = ("pose",)

    @dataclass
    class State:
        heard: int = 0

    @on("system", Pose)
    def pose(self, packet):
        if packet.source == f"{self.agent}/device/pose":
            self.publish("ctrl", Load(packet.body.x_m))


@pytest.fixture
def walk(tmp_path):
    """A recording of an agent with a real pose and no task."""
    with Fleet() as fleet:
        agent = fleet.start("a", devices={"pose": {"type": Walk, "rate_hz": 5}})
        with recorded(tmp_path, agent):
            fleet.run_for(3.0)
    return tmp_path


def answers(folder):
    entries = [entry for entry in RecordingReader(folder).entries() if entry.packet.channel == "ctrl"]
    return [(entry.packet.body.cpu, entry.packet.stamp_s) for entry in entries]


def replayed(walk, out, scale=1.0, **selection):
    plugins = registered({"test.Follow": Follow})
    with VirtualReplay([parse(CONFIG, "a.toml")], out, plugins) as fleet:
        chosen = Selection(fleet.start(), **selection)
        tally = tally_of(chosen, RecordingReader(walk).entries())
        assert tally.first_ns is not None
        fleet.feed(chosen, RecordingReader(walk).entries(), tally.first_ns, scale)
        return fleet.tally


def test_replayed_readings_reach_a_task_at_their_times(walk, tmp_path):
    poses = [entry.packet for entry in RecordingReader(walk).entries() if entry.packet.type == "pose"]
    assert replayed(walk, tmp_path / "out").fed() == len(poses) >= 14
    found = answers(tmp_path / "out")
    assert [x_m for x_m, _ in found] == [packet.body.x_m for packet in poses]
    gaps = [after - before for (_, before), (_, after) in zip(found, found[1:], strict=False)]
    assert gaps == pytest.approx([0.2] * len(gaps), abs=1e-6)


def test_virtual_replay_scales_and_is_reproducible(walk, tmp_path):
    for name in ("one", "two"):
        replayed(walk, tmp_path / name, scale=0.5)
    one, two = answers(tmp_path / "one"), answers(tmp_path / "two")
    assert one == two
    assert one[-1][1] - one[0][1] == pytest.approx(0.1 * (len(one) - 1), abs=1e-6)


def test_virtual_replay_refuses_two_agents_of_one_name(tmp_path):
    with pytest.raises(ConfigError, match="two of the agents are called 'a'"):
        VirtualReplay([parse(CONFIG, "a.toml")] * 2, tmp_path, registered({}))
