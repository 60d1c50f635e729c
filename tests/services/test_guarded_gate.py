"""Where the permit of a guarded task is looked at: the last place before a command, a packet or a checkpoint leaves."""

from typing import Any

import pytest
from services.counting import Count
from services.numbered import Numbered

from pancakes.control import Describe, Guarding
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.durable.record import TaskId
from pancakes.kernel.actor import core_of
from pancakes.kernel.permits import PermitEnd
from pancakes.packet import Packet
from pancakes.task import Task, every
from pancakes.testing import Fleet

LEASE_S = 2.0
GUARD = {"copies": 3, "lease_s": LEASE_S, "guardians": ["b", "c"], "takeover": "ask"}


class Wheels(Actuator):
    """Wheels that write down what they are told, when, and for how long that is good."""

    type = "motors"
    told: list[Any]

    def open(self):
        type(self).told = []

    def write(self, command, ttl_s, source):
        self.told.append((self.context.now(), ttl_s))

    def safe_stop(self):
        self.told.append((self.context.now(), "hold"))


class WithDeadMan(Wheels):
    """The same, with firmware that counts."""

    def watchdog_s(self, hold_after_s):
        return hold_after_s


class Drive(Task):
    """Commands its wheels twenty times a second, and tells an agent how often it did."""

    requires = ("motors",)
    published: Any = staticmethod(lambda: None)

    def on_start(self):
        self.n = 0

    @every(hz=20)
    def drive(self, tick):
        self.n += 1
        self.publish("ctrl", Twist(0.1, 0.0))
        self.publish("system", Numbered(self.n), to="d")
        type(self).published()


def record(fleet, name="Drive"):
    return fleet.agents["a"].agent.records.get(TaskId("a", name))


def started(wheels=WithDeadMan, cls=Drive, checkpoint_s=1.0, **others):
    fleet = Fleet(seed=5)
    fleet.start("d", devices={"motors": WithDeadMan} if wheels == "network.motors" else None)
    device = {"type": wheels, "settings": {"target": "d/device/motors"}} if wheels == "network.motors" else wheels
    fleet.start(
        "a",
        tasks={cls.__name__: {"type": cls, "guard": {**GUARD, "checkpoint_s": checkpoint_s}, **others}},
        devices={"motors": device},
    )
    for other in "bc":
        fleet.start(other)
    fleet.connect()
    assert fleet.run_until(
        lambda: len(record(fleet, cls.__name__).register.sets) == 1 and record(fleet, cls.__name__).guarded, 10
    )
    fleet.run_for(1.0)
    return fleet


@pytest.fixture
def fleet():
    with started() as made:
        yield made


def pass_unseen(agent, boot_s, wall_s):
    """The clocks of permits go on by so much, and nothing else has noticed yet: as where a process was stopped."""
    permits, before = agent.kernel.permits, agent.kernel.permits.moment

    def moment():
        now = before()
        return PermitEnd(now.boot_s + boot_s, now.wall_s + wall_s)

    permits.moment = moment


def row(fleet):
    (found,) = fleet.agents["a"].ask(Guarding()).result
    return found


def test_a_process_that_was_stopped_holds_its_wheels_before_it_moves_them_again(fleet):
    a = fleet.agents["a"]
    late = Packet(
        "ctrl", "motors", "a/client/Drive", "", 0.0, 1, Twist(9.0, 0.0), fence=a.component("client/Drive").fence
    )
    WithDeadMan.told.clear()
    pass_unseen(a, 10.0, 10.0)
    a.kernel.stream.publish(late)  # it lay in the mailbox of the wheels
    a.kernel.stream.publish(late)
    fleet.run_for(0.02)
    assert {what for _, what in WithDeadMan.told} == {"hold"}
    (refused,) = a.events("command_refused")
    assert refused["reason"] == "a/Drive may not act until its guardians answer"
    assert row(fleet)["held_back"]["commands"] == 2
    assert fleet.run_until(lambda: a.events("permit_lost"), 1.0)
    assert fleet.run_until(lambda: WithDeadMan.told[-1][1] != "hold", 1.0), "its guardians answer, and it goes on"


def test_a_command_is_good_for_no_longer_than_the_permit(fleet):
    a = fleet.agents["a"]
    WithDeadMan.told.clear()
    fleet.faults.cut("a")
    left_s = a.kernel.permits.left_s(a.component("client/Drive").fence)
    over_s = fleet.now() + left_s
    assert fleet.run_until(lambda: a.events("permit_lost"), LEASE_S)
    ends = [at_s + ttl_s for at_s, ttl_s in WithDeadMan.told if ttl_s != "hold"]
    assert ends[0] < over_s and ends[-3:] == pytest.approx([over_s] * 3) and max(ends) < over_s + 1e-6


def test_that_travels_to_the_wheels_of_another_agent():
    with started("network.motors") as fleet:
        a = fleet.agents["a"]
        WithDeadMan.told.clear()
        fleet.run_for(0.1)
        assert {what for _, what in WithDeadMan.told} == {0.5}
        fleet.faults.cut("a", off=("b", "c"))
        over_s = fleet.now() + a.kernel.permits.left_s(a.component("client/Drive").fence)
        fleet.run_for(over_s - fleet.now() - 0.12)
        fleet.crash("a")
        fleet.run_for(1.0)
        at_s, ttl_s = WithDeadMan.told[-2]
        assert ttl_s < 0.3 and at_s + ttl_s == pytest.approx(over_s, abs=0.01)
        assert WithDeadMan.told[-1][1] == "hold" and WithDeadMan.told[-1][0] == pytest.approx(over_s, abs=0.01)


def test_a_packet_that_was_published_before_the_process_was_stopped_does_not_leave_after_that(fleet, monkeypatch):
    a, d = fleet.agents["a"], fleet.agents["d"]
    heard = []
    d.kernel.stream.tap("system", lambda packet: heard.append(packet.body.n), ("test.numbered",))
    fleet.run_for(0.2)
    assert heard
    last = a.task("Drive").n + 1
    monkeypatch.setattr(Drive, "published", lambda: pass_unseen(a, 10.0, 10.0) if a.task("Drive").n == last else None)
    fleet.run_for(0.3)
    assert last - 1 in heard and last not in heard
    assert row(fleet)["held_back"]["packets"] == 1
    assert sum("its packets are held back" in line for line in a.lines("warning")) == 1
    assert fleet.run_until(lambda: last + 3 in heard, 2.0), "it goes on once its guardians have answered"


def test_a_checkpoint_that_has_waited_for_the_disk_is_not_written_after_the_permit():
    with started(cls=Count, checkpoint_s=0.2) as fleet:
        a = fleet.agents["a"]
        fleet.run_for(1.0)
        fleet.faults.slow_disk("a", 0.3)
        place = a.component("client").places.at["Count"]
        assert fleet.run_until(lambda: place.course.pending), "one is on its way to the disk"
        no = record(fleet, "Count").register.no
        pass_unseen(a, 10.0, 10.0)
        fleet.faults.cut("a", for_s=1.0)
        fleet.run_for(0.9)
        assert record(fleet, "Count").register.no == no and row(fleet)["held_back"]["checkpoints"] >= 1
        assert fleet.run_until(lambda: record(fleet, "Count").register.no > no, 5.0)


def test_where_the_time_of_day_is_set_forward_it_stands_still_until_its_guardians_have_answered_at_once(fleet):
    a = fleet.agents["a"]
    began = len(a.events("permit_given"))
    pass_unseen(a, 0.0, 60.0)
    assert fleet.run_until(lambda: a.events("permit_lost"), 0.1)
    assert fleet.run_until(lambda: len(a.events("permit_given")) > began, 0.1)
    assert a.events("permit_given")[-1]["without_s"] < 0.1
    (stepped,) = a.events("clock_stepped")
    assert stepped["by_s"] == pytest.approx(60.0) and row(fleet)["clock_steps"] == 1
    assert any("the time of day of a was set forward by 60.0 s" in line for line in a.lines("warning"))
    n = a.task("Drive").n
    fleet.run_for(1.0)
    assert a.task("Drive").n >= n + 19 and len(a.events("permit_lost")) == 1


def test_a_task_can_ask_whether_it_may_act(fleet):
    a = fleet.agents["a"]
    task = a.task("Drive")
    assert task.may_act()
    pass_unseen(a, 10.0, 10.0)
    assert not task.may_act()
    assert fleet.run_until(task.may_act, 1.0)
    core_of(task).revoke()
    assert not task.may_act()


def test_hardware_without_a_dead_man_switch_is_warned_of_once():
    with started(Wheels) as fleet:
        a = fleet.agents["a"]
        fleet.run_for(5.0)
        (event,) = a.events("no_dead_man")
        assert (event["task"], event["device"]) == ("Drive", "motors")
        assert sum("whose hardware does not stop it unless commanded" in line for line in a.lines("warning")) == 1
        assert row(fleet)["no_dead_man"] == ["motors"]
        assert a.ask(Describe("motors")).result["watchdog_s"] is None


def test_hardware_with_one_is_not(fleet):
    a = fleet.agents["a"]
    fleet.run_for(3.0)
    assert not a.events("no_dead_man") and row(fleet)["no_dead_man"] == []
    assert a.ask(Describe("motors")).result["watchdog_s"] == 0.5


def test_what_a_task_was_when_its_agent_ended_is_written_down_without_a_permit_too():
    with started(cls=Count, checkpoint_s=0.2) as fleet:
        a = fleet.agents["a"]
        fleet.faults.cut("a")
        assert fleet.run_until(lambda: a.events("permit_lost"), 3.0)
        n, began_s = a.task("Count").state.n, fleet.now()
        fleet.stop("a")
        assert fleet.now() - began_s < 0.5
        fleet.faults.calm()
        fleet.restart("a")
        assert fleet.run_until(lambda: "Count" in fleet.agents["a"].running(), 10.0)
        assert fleet.agents["a"].task("Count").state.n >= n
