"""The tasks of the world's agent, in virtual time: the world, the motion capture, the record of the truth."""

import math
import random
import statistics
from typing import Any

import pytest

from pancakes.events import Event
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork
from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.packet import Packet
from pancakes.settings import SettingsError, make_settings
from pancakes.sim import hardware_bus
from pancakes.sim.csv_records import Trajectory, trajectory_row
from pancakes.sim.motion_capture import MotionCapture, measured
from pancakes.sim.world import World
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.supervision.messages import Carried
from pancakes.task import Task, on

BUS = "tcp://127.0.0.1:7499"
CONTENTS = {
    "bus": BUS,
    "robots": {
        "agent1": {"x_m": -1.0, "y_m": 0.0, "spread_m": 0.0, "spread_rad": 0.0},
        "agent2": {"x_m": 1.5, "y_m": -1.2},
    },
    "sensors": {"sensor": {}},
    "movers": {"mover": {"x_m": -1.5, "y_m": 1.0}},
}


class Watcher(Task):
    """Note what is published on the world's agent."""

    def on_start(self):
        self.states, self.stamps, self.poses, self.events = [], [], [], []

    @on("system", WorldState)
    def state_seen(self, packet):
        self.states.append(packet.body)
        self.stamps.append(packet.stamp_s)

    @on("log", Event)
    def event_seen(self, packet):
        self.events.append(packet.body)


class WorldAgent:
    """An agent with the tasks of a world, on one thread."""

    def __init__(self, seed=1, hold=False, trajectory="", contents=CONTENTS):
        self.dispatcher = VirtualDispatcher(seed)
        self.network = MemoryNetwork(self.dispatcher.call_at, self.dispatcher.clock.now, random.Random(1))
        self.kernel = Kernel("world", seed=seed, hold=hold, virtual=self.dispatcher)
        self.kernel.transport = self.network.transport("world")
        self.sent: list[Packet] = []
        self.kernel.stream.gateway = self.sent.append
        self.watcher = self.kernel.spawn(Watcher, "world/client/Watcher")
        self.dispatcher.settle()
        self.world = self.spawn(World, contents)
        self.capture = self.spawn(MotionCapture, {"targets": {"agent1": "agent1/device/pose"}})
        if trajectory:
            self.trajectory = self.spawn(Trajectory, {"path": trajectory})

    def spawn(self, cls, settings):
        return self.kernel.spawn(cls, f"world/client/{cls.__name__}", carried=Carried(settings, {}))

    def run_until(self, time_s):
        self.dispatcher.run_until(time_s)


class Robot(ConnectionHandler):
    """The other end of the hardware bus: keeps a body driving."""

    def __init__(self, agent):
        self.replies: list[Any] = []
        self.connection: Connection | None = None
        self._reader = hardware_bus.ReplyReader()
        agent.network.transport("agent1").dial(BUS, self)

    def opened(self, connection):
        self.connection = connection

    def received(self, data):
        self.replies.extend(self._reader.feed(data))

    def closed(self, reason):
        self.connection = None

    def send(self, request):
        assert self.connection is not None
        self.connection.send(hardware_bus.encode(request))


def test_states_come_at_exact_multiples_of_the_period():
    agent = WorldAgent()
    agent.run_until(1.0)
    times = [state.time_s for state in agent.watcher.states]
    assert times == pytest.approx([0.05 * k for k in range(21)], abs=1e-9)


@pytest.mark.parametrize("state_hz", [10.0, 20.0, 50.0])
def test_a_state_is_told_at_its_own_time(state_hz):
    agent = WorldAgent(contents={**CONTENTS, "state_hz": state_hz})
    agent.run_until(1.0)
    assert len(agent.watcher.states) == state_hz + 1
    assert agent.watcher.stamps[1:] == pytest.approx([state.time_s for state in agent.watcher.states[1:]], abs=1e-9)


def test_the_world_stands_while_the_mission_waits_at_0():
    agent = WorldAgent(hold=True)
    agent.run_until(5.0)
    assert agent.watcher.states == []
    agent.kernel.begin(0.0)
    agent.run_until(5.5)
    assert agent.watcher.states[0].time_s == 0.0
    assert agent.watcher.states[-1].time_s == pytest.approx(0.5)


def test_a_command_over_the_bus_moves_a_robot_until_it_is_stale():
    agent = WorldAgent()
    robot = Robot(agent)
    agent.run_until(1.0)
    robot.send(hardware_bus.Drive("agent1", "motors", 0.1, 0.1, 0.5, "agent1/client/ScanTarget"))
    agent.run_until(1.4)
    moving = agent.watcher.states[-1].bodies[0]
    assert (moving.v_mps, moving.driven_by) == (pytest.approx(0.1, rel=0.05), "ScanTarget")
    agent.run_until(3.0)
    resting = agent.watcher.states[-1].bodies[0]
    assert (resting.v_mps, resting.driven_by) == (0.0, "")
    assert resting.x_m == pytest.approx(-0.95, abs=0.005)


def test_a_sample_over_the_bus_is_answered_and_what_cannot_be_is_refused():
    agent = WorldAgent()
    robot = Robot(agent)
    agent.run_until(1.0)
    robot.send(hardware_bus.Sample("agent1", "ir", "ir"))
    robot.send(hardware_bus.Sample("nobody", "ir2", "ir"))
    robot.send(hardware_bus.Attach("agent1", "motors", "motors", "pioneer3dx"))
    robot.send(hardware_bus.Attach("agent2", "motors", "motors", "khepera3"))
    agent.run_until(1.1)
    reading, nobody, wrong_model, attached = robot.replies
    assert attached == hardware_bus.Attached("motors")
    assert (reading.device, reading.type, len(reading.body().ranges_m)) == ("ir", "ir", 9)
    assert (nobody.device, nobody.reason) == ("ir2", "the simulated world has no robot 'nobody', only agent1, agent2")
    assert "agent1 is a khepera3" in wrong_model.reason


def test_a_collision_is_an_event():
    agent = WorldAgent()
    robot = Robot(agent)
    agent.run_until(1.0)
    robot.send(hardware_bus.Drive("agent1", "motors", 0.3, 0.3, 10.0, "agent1/client/ScanTarget"))
    agent.run_until(6.0)
    (collision,) = [event for event in agent.watcher.events if event.kind == "collision"]
    assert collision.fields["names"] == ["agent1", "sensor"]
    assert collision.fields["time_s"] == pytest.approx(1.0 + (1.0 - 0.125) / 0.3, abs=0.1)


def test_the_motion_capture_sends_each_target_its_pose_with_a_little_noise():
    agent = WorldAgent()
    agent.run_until(10.0)
    poses = [packet for packet in agent.sent if packet.type == "pose"]
    assert len(poses) == pytest.approx(100, abs=1)
    assert {packet.destination for packet in poses} == {"agent1/device/pose"}
    assert {packet.channel for packet in poses} == {"system"}
    assert statistics.mean(packet.body.x_m for packet in poses) == pytest.approx(-1.0, abs=0.0005)
    assert 0.0005 < statistics.stdev(packet.body.x_m for packet in poses) < 0.002


def test_a_measured_heading_stays_within_a_half_turn():
    body = BodyState("a", "robot", 0.0, 0.0, math.pi, 0.0, 0.0)
    source = random.Random(1).gauss
    headings = [measured(body, 0.0, 0.01, source).theta_rad for _ in range(100)]
    assert all(-math.pi < heading <= math.pi for heading in headings)
    assert min(headings) < 0.0 < max(headings)


def test_the_trajectory_has_a_row_for_each_body_ten_times_a_second(tmp_path):
    path = tmp_path / "out" / "trajectory.csv"
    agent = WorldAgent(trajectory=str(path))
    agent.run_until(5.01)
    agent.trajectory.actor_ref.stop(block=False)
    agent.dispatcher.settle()
    lines = path.read_text().splitlines()
    assert lines[0] == Trajectory.header
    rows = [line.split(",") for line in lines[1:]]
    assert len(rows) == 4 * 51
    assert [cells[1] for cells in rows[:4]] == ["agent1", "agent2", "sensor", "mover"]
    assert rows[0] == ["0.000", "agent1", "-1.000000", "0.000000", "0.000000", "0.000000", "0.000000", "8.4000", ""]
    assert [cells[0] for cells in rows[::4]] == [f"{k / 10:.3f}" for k in range(51)]
    assert rows[2][7] == ""


def test_what_was_written_is_on_the_disk_within_a_second(tmp_path):
    path = tmp_path / "trajectory.csv"
    agent = WorldAgent(trajectory=str(path))
    agent.run_until(3.05)
    assert len(path.read_text().splitlines()) > 4 * 20
    agent.trajectory.actor_ref.stop(block=False)
    agent.dispatcher.settle()


def test_the_same_seed_writes_the_same_bytes(tmp_path):
    def written(name, seed):
        path = tmp_path / name
        agent = WorldAgent(seed, trajectory=str(path))
        agent.run_until(20.0)
        agent.trajectory.actor_ref.stop(block=False)
        agent.dispatcher.settle()
        return path.read_bytes()

    first = written("first.csv", 1)
    assert written("second.csv", 1) == first
    assert written("third.csv", 2) != first


def test_a_row_never_shows_a_negative_zero():
    body = BodyState("agent1", "robot", -1e-9, -0.5, 0.0, -0.0, 0.0, 8.25, "GoHome")
    assert trajectory_row(12.3, body) == "12.300,agent1,0.000000,-0.500000,0.000000,0.000000,0.000000,8.2500,GoHome"


def test_a_period_that_is_no_whole_number_of_steps_is_refused():
    with pytest.raises(SettingsError, match="state_hz = 15.* gives a period that is no whole number"):
        make_settings(World.Settings, {"state_hz": 15.0})
