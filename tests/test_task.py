"""What a task's author writes, and what comes of it."""

import threading
from dataclasses import dataclass, field
from typing import TypeVar

import pytest

from pancakes.control import Configure, Reply, Reschedule, Stop
from pancakes.devices import Load, Pose, Twist
from pancakes.errors import ClassError
from pancakes.settings import SettingsError
from pancakes.supervision.messages import Carried
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, assert_published


@pytest.fixture
def fleet():
    with Fleet(seed=6) as made:
        yield made


class Follow(Task):
    """Turns towards what it sees: event-driven, time-driven, with settings and state."""

    requires = ("motors",)

    @dataclass
    class Settings:
        gain: float = 1.0

    @dataclass
    class State:
        seen: int = 0
        where: list[tuple[float, float]] = field(default_factory=list)

    def on_start(self):
        self.log("info", f"gain is {self.settings.gain}")

    @on("system", Pose, queue="latest")
    def steer(self, packet):
        self.state.seen += 1
        self.state.where.append((packet.body.x_m, packet.body.y_m))
        self.publish("ctrl", Twist(0.1, self.settings.gain * packet.body.theta_rad))

    @every(hz=2)
    def report(self, tick):
        self.event("report", seen=self.state.seen)


def test_a_task_reacts_to_packets_and_to_time(fleet):
    agent = fleet.start(
        "a", tasks={"Follow": {"type": Follow, "settings": {"gain": 2.0}}}, devices={"m": "null.motors"}
    )
    agent.publish("system", Pose(1.0, 2.0, 0.25))
    fleet.run_for(1.0)
    assert "gain is 2.0" in agent.lines("info")
    assert_published(agent, Twist, lambda twist: twist == Twist(0.1, 0.5), source="a/client/Follow", times=1)
    assert [event["seen"] for event in agent.events("report")] == [1, 1]
    assert agent.task("Follow").state == Follow.State(1, [(1.0, 2.0)])


def test_of_what_it_wants_only_the_latest_of_it_gets_the_latest(fleet):
    agent = fleet.start("a", tasks={"Follow": Follow}, devices={"m": "null.motors"})
    for x_m in range(5):
        agent.publish("system", Pose(float(x_m), 0.0, 0.0))
    fleet.run_for(0.0)
    assert agent.task("Follow").state.where == [(4.0, 0.0)]
    assert agent.slot("Follow").mailbox.dropped() == 0, "it got what it wants"


def test_a_task_controls_others_by_packets_and_is_answered(fleet):
    class Watchdog(Task):
        @every(hz=1)
        def watch(self, tick):
            if tick.time_s == 2.0:
                self.asked = self.publish("sysctrl", Reschedule("Follow", 10.0))

        @on("sysctrl", Reply)
        def answered(self, packet):
            assert packet.cause == (self.address, self.asked.seq)
            self.event("answered", ok=packet.body.ok)

    agent = fleet.start("a", tasks={"Follow": Follow, "Watchdog": Watchdog}, devices={"m": "null.motors"})
    fleet.run_for(4.0)
    assert agent.events("answered", ok=True)
    assert len(agent.events("report")) == 4 + 20


def test_a_task_may_put_off_and_draw(fleet):
    class Dice(Task):
        def on_start(self):
            self.after(1.5, self.throw)

        def throw(self):
            self.event("thrown", eyes=self.random.randint(1, 6), at_s=round(self.now(), 3))
            self.after(1.0, self.throw)

    agent = fleet.start("a", tasks={"Dice": Dice})
    fleet.run_for(5.0)
    thrown = agent.events("thrown")
    assert [event["at_s"] - thrown[0]["at_s"] for event in thrown] == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=0.002)


def test_a_task_may_open_a_channel_and_close_it_again(fleet):
    class Mapper(Task):
        def on_start(self):
            self.open_channel("map")

        def on_stop(self):
            self.close_channel("map")

        @every(hz=1)
        def draw(self, tick):
            self.publish("map", Load(1.0))

    agent = fleet.start("a", tasks={"Mapper": Mapper})
    agent.probe.follow("map")
    fleet.run_for(3.0)
    assert_published(agent, Load, channel="map", times=3)
    assert agent.ask(Stop("Mapper")).ok
    assert "map" not in agent.kernel.stream.channels()


def test_settings_of_the_wrong_type_keep_a_task_from_starting(fleet):
    agent = fleet.start(
        "a", tasks={"Follow": {"type": Follow, "settings": {"gain": "much"}}}, devices={"m": "null.motors"}
    )
    fleet.run_for(1.0)
    (given_up,) = agent.events("task_given_up")
    assert "gain: expected a number" in given_up["error"]


def test_settings_are_replaced_as_a_whole_and_the_task_is_told(fleet):
    class Told(Follow):
        def on_settings(self):
            self.event("told", gain=self.settings.gain)

    agent = fleet.start("a", tasks={"Told": Told}, devices={"m": "null.motors"})
    before = agent.task("Told").settings
    assert agent.ask(Configure("Told", {"gain": 3.0})).ok
    assert agent.events("told", gain=3.0)
    assert before.gain == 1.0
    with pytest.raises(SettingsError, match="bad settings for Told: gian: unknown key"):
        agent.component("client/Told").change_settings({"gian": 1.0})


def test_a_task_inherits_what_its_base_listens_to(fleet):
    class Keen(Follow):
        @every(hz=20)
        def report(self, tick):
            super().report(tick)

    agent = fleet.start("a", tasks={"Keen": Keen}, devices={"m": "null.motors"})
    agent.publish("system", Pose(1.0, 0.0, 0.0))
    fleet.run_for(1.0)
    assert len(agent.events("report", seen=1)) in (19, 20)


@pytest.mark.parametrize("period_s", [0.0, -1.0, 1e-300, float("nan")])
def test_a_period_that_is_none_ends_the_task_that_brings_it_and_no_timer(fleet, period_s):
    """A snapshot from another agent may say anything."""

    class Ticking(Task):
        @every(hz=2)
        def tick(self, tick):
            self.event("tick")

    agent = fleet.start("a", tasks={"Ticking": Ticking})
    ends = []
    agent.kernel.spawn(
        Ticking,
        "a/client/Strange",
        carried=Carried({}, {}, {"tick": period_s}),
        exited=lambda component, error: ends.append(str(error)),
    )
    fleet.run_for(2.0)
    assert len(ends) == 1 and "a period must be at least 0.0001 s" in ends[0]
    assert len(agent.events("tick")) == 4


@dataclass
class Gains:
    gain: float = 1.5


@dataclass
class Counted:
    count: int = 0


SettingsT = TypeVar("SettingsT")


def test_task_takes_its_settings_and_state_from_brackets():
    class Both(Task[Gains, Counted]):
        """Has both."""

    class One(Task[Gains]):
        """Has settings only."""

    class Below(Both):
        """Has those of its base."""

    class Base(Task[SettingsT, Counted]):
        """Leaves the settings open."""

    class Filled(Base[Gains]):
        """Says which."""

    class Own(Task[Gains, Counted]):
        @dataclass
        class Settings:
            other: int = 1

    assert (Both.Settings, Both.State) == (Gains, Counted)
    assert (One.Settings, One.State) == (Gains, Task.State)
    assert (Below.Settings, Below.State) == (Gains, Counted)
    assert (Base.Settings, Base.State) == (Task.Settings, Counted)
    assert (Filled.Settings, Filled.State) == (Gains, Counted)
    assert Own.Settings is not Gains and Own.State is Counted


def test_task_refuses_what_cannot_be_saved_in_brackets():
    @dataclass
    class Odd:
        thing: threading.Lock

    with pytest.raises(ClassError, match="thing"):

        class Bad(Task[Gains, Odd]):
            """Its state cannot move."""
