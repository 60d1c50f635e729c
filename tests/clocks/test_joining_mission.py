"""An agent that has just begun takes the mission's time from its fleet; one that runs never jumps."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from clocks.pulses import PulseReader, PulseTeller

from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet


class Stopwatch(Task):
    """Remembers the mission times that it has seen."""

    def on_start(self) -> None:
        self.started_s = self.now()
        self.ticks: list[Tick] = []
        self.called_s: list[float] = []
        self.after(2.0, lambda: self.called_s.append(self.now()))

    @every(hz=2)
    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)


@pytest.fixture
def fleet():
    with Fleet() as made:
        yield made


def start(fleet, name, join_s=1.0, **more):
    return fleet.start(name, join_s=join_s, **more)


def missions(fleet):
    return {name: agent.kernel.mission.now() for name, agent in fleet.agents.items()}


def test_an_agent_that_joins_goes_on_at_the_fleets_time(fleet):
    start(fleet, "a")
    start(fleet, "b")
    fleet.run_for(100.0)
    c = start(fleet, "c", tasks={"Stopwatch": Stopwatch})
    assert missions(fleet) == {name: pytest.approx(missions(fleet)["a"], abs=0.001) for name in "abc"}
    joined = c.wait_for_event("mission_joined")
    assert joined["peer"] in "ab" and 0 < joined["bound_s"] < 0.002


def test_no_task_sees_the_time_jump(fleet):
    start(fleet, "a")
    fleet.run_for(100.2)
    b = start(fleet, "b", tasks={"Stopwatch": Stopwatch})
    fleet.run_for(5.0)
    task = b.task("Stopwatch")
    assert task.started_s > 100.0
    assert [tick.time_s for tick in task.ticks[:3]] == [100.5, 101.0, 101.5]
    assert all(tick.missed == 0 for tick in task.ticks)
    assert task.called_s == [pytest.approx(task.started_s + 2.0)]


def test_an_agent_that_comes_back_goes_on_at_the_fleets_time(fleet):
    start(fleet, "a")
    start(fleet, "b")
    fleet.run_for(50.0)
    fleet.crash("b")
    fleet.run_for(50.0)
    fleet.restart("b")
    assert missions(fleet)["b"] == pytest.approx(missions(fleet)["a"], abs=0.001)


def test_one_that_dials_no_other_waits_to_be_dialled_where_it_comes_back(fleet):
    start(fleet, "hub", peers=())
    start(fleet, "b", peers=("tcp://hub:7400",))
    fleet.run_for(50.0)
    fleet.crash("hub")
    fleet.run_for(0.3)
    start(fleet, "hub", peers=())
    assert missions(fleet)["hub"] == pytest.approx(missions(fleet)["b"], abs=0.001)


def test_an_agent_alone_begins_at_once(fleet):
    before_s = fleet.now()
    start(fleet, "a", peers=())
    assert fleet.now() - before_s < 0.01 and missions(fleet)["a"] < 0.01


def test_peers_that_cannot_be_reached_are_not_waited_for(fleet):
    before_s = fleet.now()
    start(fleet, "a", peers=("tcp://nothing-there:7400",))
    assert fleet.now() - before_s < 0.1 and missions(fleet)["a"] < 0.1


def test_peers_that_do_not_answer_are_waited_for_no_longer_than_that(fleet):
    start(fleet, "a")
    fleet.network.partition(["a"], ["b"])
    before_s = fleet.now()
    start(fleet, "b", join_s=0.7)
    assert fleet.now() - before_s == pytest.approx(0.7, abs=0.05) and missions(fleet)["b"] < 0.1


def test_agents_that_run_never_jump_where_two_fleets_meet(fleet):
    start(fleet, "a")
    fleet.run_for(30.0)
    fleet.network.partition(["a"], ["b"])
    start(fleet, "b", join_s=0.2)
    before = missions(fleet)
    assert before["a"] - before["b"] > 29.0
    fleet.network.heal()
    fleet.connect(30.0)
    fleet.run_for(10.0)
    after = missions(fleet)
    assert after["a"] - after["b"] == pytest.approx(before["a"] - before["b"], abs=1e-6)


def test_of_two_missions_that_meet_a_new_agent_takes_the_older(fleet):
    start(fleet, "a")
    fleet.run_for(30.0)
    start(fleet, "b", join_s=0.0)
    fleet.connect()
    fleet.run_for(5.0)
    start(fleet, "c")
    assert missions(fleet)["c"] == pytest.approx(missions(fleet)["a"], abs=0.001)


def test_a_mission_that_is_held_everywhere_stays_held(fleet):
    start(fleet, "a", hold=True)
    b = start(fleet, "b", hold=True)
    fleet.run_for(5.0)
    assert b.kernel.mission.held
    for agent in fleet.agents.values():
        agent.kernel.begin(0.5)
    fleet.run_for(10.0)
    fleet.crash("b")
    fleet.run_for(3.0)
    fleet.restart("b")
    assert missions(fleet)["b"] == pytest.approx(missions(fleet)["a"], abs=0.001)


def test_a_mission_at_another_speed_is_another_one(fleet):
    start(fleet, "a", speed=2.0)
    fleet.run_for(20.0)
    b = start(fleet, "b")
    assert missions(fleet)["b"] < 1.0
    b.wait_until(lambda: any("the mission of a runs at speed 2 and here at 1:" in line for line in b.lines("warning")))


def test_of_several_missions_at_another_speed_the_first_is_named(fleet):
    start(fleet, "a", speed=2.0)
    start(fleet, "b", speed=3.0)
    fleet.run_for(20.0)
    c = start(fleet, "c")
    c.wait_until(lambda: any("at another" in line or "runs at speed" in line for line in c.lines("warning")))
    assert [line.partition(" and here")[0] for line in c.lines("warning") if "runs at speed" in line] == [
        "the mission of a runs at speed 2"
    ]


def test_a_terminal_and_a_peer_without_the_right_are_not_believed(fleet):
    start(fleet, "a", role="client")
    fleet.run_for(20.0)
    start(fleet, "b", join_s=0.5)
    assert missions(fleet)["b"] < 1.0
    rule = '[[access.allow]]\nwho = ["*"]\nmay = ["publish"]\non = ["system", "network"]\n'
    start(fleet, "c", text=rule, peers=("tcp://b:7400",))
    fleet.run_for(20.0)
    d = start(fleet, "d", text=rule, peers=("tcp://b:7400", "tcp://c:7400"))
    assert d.kernel.mission.now() < 1.0


def test_a_peer_that_lies_about_its_mission_moves_no_clock(fleet):
    """It claims that its mission has run for thirty years: agents that run do not care, a new one believes the most."""
    for name in ("a", "b"):
        start(fleet, name)
    fleet.run_for(10.0)
    liar = start(fleet, "liar", hold=True, join_s=0.0, tasks={"Teller": PulseTeller})
    liar.kernel.join(liar.kernel.host.now() - 9e8)
    fleet.connect()
    before = missions(fleet)
    c = start(fleet, "c", tasks={"Reader": PulseReader})
    assert before["liar"] > 8e8 and missions(fleet)["c"] == pytest.approx(missions(fleet)["a"], abs=0.001)
    fleet.run_for(10.0)
    assert missions(fleet)["a"] == pytest.approx(before["a"] + 10.0, abs=1.0)
    *_, (now_s, _, packet, local, age_s) = c.task("Reader").heard  # its own stamps are told as well as they can be
    assert packet.stamp_s > 8e8 and local.time_s == pytest.approx(now_s, abs=0.1) and 0.0 <= age_s < 0.1


def test_what_a_task_kept_means_the_same_after_its_agent_has_come_back(fleet):
    """A time that lies in the state of a durable task is one of the mission, not of a life of its agent."""

    class Noting(Task):
        @dataclass
        class State:
            noted_s: float = 0.0

        @every(hz=1)
        def tick(self, tick: Tick) -> None:
            self.state.noted_s = self.state.noted_s or self.now()

    start(fleet, "a")
    start(fleet, "b", tasks={"Noting": Noting})
    fleet.run_for(20.0)
    noted_s = fleet.agents["b"].task("Noting").state.noted_s
    fleet.crash("b")
    fleet.run_for(5.0)
    b = fleet.restart("b")
    task = b.task("Noting")
    assert task.state.noted_s == noted_s
    assert task.now() - noted_s == pytest.approx(fleet.now() - noted_s, abs=0.1) and task.now() > 24.0
