"""`pancakes.simulation`: built in code, from files and from a demo; reset, stepped, read; several at once."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec import Struct

from pancakes.control import Configure, Describe, Migrate
from pancakes.errors import ConfigError, PancakesError
from pancakes.packet import NEIGHBOURS, SYSTEM, Packet, packet_type
from pancakes.simulation import Simulation, SimulationError
from pancakes.task import Task, Tick, every, on

ROBOT = """
schema = 1
[agent]
name = "robot"
listen = "tcp://127.0.0.1:7401"
peers = ["tcp://world:7400"]
[device.pose]
driver = "sim.pose"
rate_hz = 10
settings = { world = "tcp://world:7499" }
"""
ROOM = {"bus": "tcp://world:7499", "robots": {"robot": {"x_m": 0.5, "y_m": -0.5}}}


@packet_type("simulation.beat")
class Beat(Struct, frozen=True):
    count: int


class Heart(Task):
    @dataclass
    class Settings:
        loud: bool = False

    @dataclass
    class State:
        beats: int = 0
        heard: int = 0
        first_s: float = -1.0

    settings: Settings
    state: State

    @every(hz=2)
    def beat(self, tick: Tick) -> None:
        if not self.state.beats:
            self.state.first_s = self.now()
        self.state.beats += 1
        self.publish(SYSTEM, Beat(self.state.beats), to=NEIGHBOURS)

    @on(SYSTEM, Beat)
    def heard(self, packet: Packet) -> None:
        if packet.source != self.address:
            self.state.heard += 1


@pytest.fixture
def hearts(no_leaks):
    with Simulation() as simulation:
        yield simulation.add("a", tasks={"Heart": Heart}).add("b", tasks={"Heart": Heart})


def course(simulation: Simulation, seed: int, looks: int = 1) -> list[object]:
    """Run ten seconds of a demo; returns what the world and the agents were then."""
    simulation.reset(seed)
    for _ in range(looks):
        simulation.step(10.0 / looks)
        simulation.world(), simulation.tasks()
    return [simulation.world(), simulation.tasks(), simulation.agents["agent1"].events()]


def test_the_same_seed_gives_the_same_run_however_often_it_is_looked_at(no_leaks):
    with Simulation.of_demo("encirclement") as simulation:
        once = course(simulation, 7)
        assert course(simulation, 7, looks=64) == once
        assert course(simulation, 8) != once
        assert course(simulation, 7) == once


def test_several_run_side_by_side_and_do_not_touch_each_other(no_leaks):
    with Simulation.of_demo("encirclement") as alone:
        expected = [course(alone, seed) for seed in (1, 2)]
    with Simulation.of_demo("encirclement") as one, Simulation.of_demo("encirclement") as other:
        one.reset(1)
        other.reset(2)
        for _ in range(20):
            one.step(0.5)
            other.step(0.5)
        found = [[it.world(), it.tasks(), it.agents["agent1"].events()] for it in (one, other)]
    assert found == expected


def test_all_mission_clocks_begin_together_at_0(hearts):
    hearts.reset()
    assert hearts.now_s == 0.0
    assert {handle.kernel.mission.now() for handle in hearts.agents.values()} == {0.0}
    hearts.step(3.0)
    assert hearts.now_s == pytest.approx(3.0)
    assert [handle.kernel.mission.now() for handle in hearts.agents.values()] == pytest.approx([3.0, 3.0])
    assert hearts.task("a", "Heart").state == Heart.State(beats=6, heard=5, first_s=0.5)


def test_an_agent_from_a_file_and_a_world_in_code(tmp_path: Path, no_leaks):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    with Simulation() as simulation:
        simulation.add("world", tasks={"World": {"type": "sim.world", "settings": ROOM}})
        simulation.load(path, ["device.pose.rate_hz=5"])
        simulation.reset(3)
        simulation.step(1.0)
        assert simulation.world().time_s == pytest.approx(1.0)
        body = simulation.body("robot")
        assert (body.x_m, body.y_m) == pytest.approx((0.5, -0.5), abs=0.021)
        pose = next(task for task in simulation.tasks() if task["task"] == "pose")
        assert (pose["agent"], pose["state"], pose["rate_hz"]) == ("robot", "running", 5.0)
        with pytest.raises(SimulationError, match=r"no body 'robto', only robot$"):
            simulation.body("robto")


def test_tasks_are_told_as_a_running_agent_tells_them(hearts):
    hearts.reset()
    told = hearts.agents["a"].ask(Describe()).result["tasks"]
    assert [task["task"] for task in told] == [task["task"] for task in hearts.agents["a"].tasks()]
    assert {task["task"]: task["state"] for task in told} == {
        task["task"]: task["state"] for task in hearts.agents["a"].tasks()
    }


def test_agents_take_commands_and_tasks_move(hearts):
    hearts.add("b")
    hearts.reset()
    assert hearts.agents["a"].ask(Configure("Heart", {"loud": True})).ok
    assert hearts.task("a", "Heart").settings.loud
    assert hearts.where("Heart") == ["a"]
    assert hearts.agents["a"].ask(Migrate("Heart")).ok
    assert hearts.step_until(lambda: hearts.where("Heart") == ["b"])


def test_what_goes_wrong_is_over_at_the_next_reset(hearts):
    hearts.reset(1)
    hearts.faults.lose(1.0, Beat)
    hearts.step(10.0)
    assert hearts.task("a", "Heart").state.heard == 0
    hearts.reset(1)
    hearts.step(10.0)
    assert hearts.task("a", "Heart").state.heard == 19


def test_an_agent_that_crashed_is_started_again_on_its_disk(hearts):
    hearts.reset()
    hearts.step(20.0)
    hearts.crash("a")
    hearts.step(10.0)
    assert list(hearts.agents) == ["b"] and hearts.where("Heart") == ["b"]
    hearts.restart("a")
    hearts.step(5.0)
    assert hearts.task("a", "Heart").state.beats >= 48
    with pytest.raises(SimulationError, match="the agent a runs: it is started again once"):
        hearts.restart("a")
    hearts.stop("a")
    with pytest.raises(SimulationError, match="no agent 'a', only b"):
        hearts.crash("a")
    hearts.reset()
    hearts.step(1.0)
    assert hearts.task("a", "Heart").state.beats == 2


def test_what_it_cannot_do_is_said_in_a_sentence(hearts, tmp_path: Path):
    with pytest.raises(SimulationError, match="does not run: call `reset` first"):
        hearts.step(1.0)
    with Simulation() as empty, pytest.raises(SimulationError, match="has no agents yet"):
        empty.reset()
    hearts.reset()
    for seconds in (-1.0, float("inf"), float("nan")):
        with pytest.raises(SimulationError, match="cannot step by"):
            hearts.step(seconds)
    with pytest.raises(SimulationError, match="no agent of this simulation runs a simulated world"):
        hearts.world()
    with pytest.raises(SimulationError, match="no agent 'c', only a, b"):
        hearts.task("c", "Heart")
    with pytest.raises(SimulationError, match="Hearth does not run on a, only"):
        hearts.task("a", "Hearth")
    path = tmp_path / "bad.toml"
    path.write_text(ROBOT.replace("rate_hz", "rate"))
    with pytest.raises(ConfigError, match=r"bad\.toml:9: \[device\.pose\] rate"):
        hearts.load(path)
    with pytest.raises(PancakesError, match="unknown demo 'encirclment'.*did you mean 'encirclement'"):
        Simulation.of_demo("encirclment")


def test_of_many_agents_that_cannot_meet_some_are_named():
    with Simulation() as simulation:
        simulation.add("a", peers=())
        for number in range(12):
            simulation.add(f"b{number}", peers=())
        with pytest.raises(SimulationError, match=r"a has not met b0, b1, .*, b7 and 4 others; b0 has not met a, b1"):
            simulation.reset()


def test_agents_that_cannot_meet_are_named(no_leaks):
    with Simulation() as simulation:
        simulation.add("a").add("b", peers=())
        with pytest.raises(SimulationError, match="cannot begin after 120 s of virtual time: a has not met b"):
            simulation.reset()
        with pytest.raises(SimulationError, match="call `reset` first"):
            simulation.step(1.0)


def test_a_comparison_is_its_mission_and_its_files_go_where_they_are_wanted(tmp_path: Path, monkeypatch, no_leaks):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with Simulation.of_demo("energy", ["agent1:task.EnergyGovernor.start=false"], out=tmp_path / "out") as simulation:
        simulation.reset()
        simulation.step(2.0)
        governor = next(task for task in simulation.tasks() if task["task"] == "EnergyGovernor")
        assert governor["state"] == "stopped"
    assert (tmp_path / "out" / "trajectory.csv").stat().st_size > 0
    with Simulation.of_demo("energy") as simulation:
        simulation.reset()
        assert list((tmp_path / "temporary").iterdir())
    assert not list((tmp_path / "temporary").iterdir())


def test_an_agent_with_a_few_links_has_no_more_once_it_is_started_again() -> None:
    with Simulation() as simulation:
        for number in range(12):
            simulation.add(f"a{number:02d}", links=2)
        simulation.reset(seed=3)
        simulation.step(5.0)
        simulation.crash("a05")
        simulation.step(5.0)
        assert 2 <= len(simulation.restart("a05").agent.mesh.connected()) < 6


def test_unknown_key_of_a_task_in_code_is_refused(no_leaks):
    with Simulation() as simulation, pytest.raises(ConfigError, match=r"a: \[task.Heart\] gaurd: unknown key, did you"):
        simulation.add("a", tasks={"Heart": {"type": Heart, "gaurd": {"copies": 3}}})
