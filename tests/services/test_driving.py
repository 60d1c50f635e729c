"""A drive by hand: a person has an actuator for a time, and what commanded it before waits and goes on."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pancakes.control import Drive, EndDrive, EndHalt, Halt, Migrate, Restart, Start, Stop
from pancakes.devices import Pose, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.errors import MailboxFullError
from pancakes.services.driving import SILENT_S, HandDrive
from pancakes.task import Task, every
from pancakes.testing import Fleet

STOP_S = 0.5


class Wheels(Actuator):
    """Writes down what it is told, for all agents."""

    type = "motors"
    told: dict[str, list] = {}

    def open(self):
        self.mine = self.told.setdefault(self.context.agent, [])

    def write(self, command, ttl_s, source):
        self.mine.append((self.context.now(), command.v_mps, source))

    def safe_stop(self):
        self.mine.append((self.context.now(), 0.0, ""))


class Place(Sensor):
    type = "pose"

    def read(self):
        return Pose(0.0, 0.0, 0.0)


class Count(Task):
    """Drives, and counts for how long."""

    requires = ("motors",)

    @dataclass
    class State:
        turns: int = 0

    @every(hz=20)
    def go(self, tick):
        self.state.turns += 1
        self.publish("ctrl", Twist(0.1, 0.0))


class Naps(Count):
    """Wakes itself by a call, which a pause does not stop."""

    def on_start(self):
        self.after(1.0, self.wake)

    def wake(self):
        self.resume()
        self.after(0.1, self.wake)


@pytest.fixture
def fleet():
    Wheels.told = {}
    with Fleet(seed=4) as made:
        yield made


def robot(fleet, name="a", task=Count, **parts):
    devices = {"motors": Wheels, "pose": {"type": Place, "rate_hz": 1}}
    made = fleet.start(name, **{"devices": devices, "tasks": {"Count": task}, **parts})
    fleet.run_for(1.0)
    return made


def person(fleet, name="alice"):
    made = fleet.start(name, role="client")
    fleet.run_for(1.0)
    return made


def newest(name="a"):
    """Return speed and source of what the wheels were told last."""
    return Wheels.told[name][-1][1:]


def begin(who, to="a", id="one", **fields):
    return who.ask(Drive("motors", id, begin=True, **fields), to=to)


def drive(fleet, who, for_s, speed_mps, id="one", to="a"):
    """Drive as a terminal does, ten times a second."""
    for _ in range(round(for_s * 10)):
        assert who.ask(Drive("motors", id, speed_mps), to=to).ok
        fleet.run_for(0.1)


def goes_on(fleet, name="a"):
    fleet.run_for(1.0)
    return newest(name) == (0.1, f"{name}/client/Count")


def test_holder_waits_with_its_state_and_goes_on_at_the_end(fleet):
    a, alice = robot(fleet), person(fleet)
    reply = begin(alice)
    assert reply.ok
    told = reply.result
    assert (told["device"], told["paused"], told["stop_after_s"]) == ("motors", "a/client/Count", STOP_S)
    assert told["driver"].startswith("alice/")
    turns = a.task("Count").state.turns
    drive(fleet, alice, 2.0, -0.3)
    assert newest() == (-0.3, "a/device/drive-motors")
    assert a.task("Count").state.turns == turns, "it waits, and counts nothing"
    (row,) = [it for it in a.tasks() if it["task"] == "Count"]
    assert (row["state"], row["rest"], row["reason"]) == ("running", "paused", "alice drives motors by hand")
    (wheels,) = [it for it in a.tasks() if it["task"] == "motors"]
    assert wheels["holder"] == "a/device/drive-motors"
    assert a.events("command_refused") == []
    assert alice.ask(EndDrive("motors", "one"), to="a").ok
    assert goes_on(fleet)
    assert turns < a.task("Count").state.turns < turns + 25
    (began,), (ended,) = a.events("drive_begun"), a.events("drive_ended")
    assert (began["holder"], began["taken_from"], ended["reason"]) == ("a/client/Count", "", "ended")
    assert began["by"] == ended["by"] == told["driver"]
    assert "drive-motors" not in [it["task"] for it in a.tasks()]
    assert begin(alice, id="two").ok, "another drive begins"


def test_robot_stops_before_the_driver_has_it(fleet):
    robot(fleet)
    alice = person(fleet)
    assert begin(alice).ok
    fleet.run_for(0.01)
    last = Wheels.told["a"][-2:]
    assert [it[1:] for it in last] == [(0.0, ""), (0.0, "a/device/drive-motors")]


@pytest.mark.parametrize("stop_s", [0.2, STOP_S, 2.0])
def test_silence_of_the_driver_stops_the_robot_in_time_and_then_ends_the_drive(fleet, stop_s):
    devices = {"motors": {"type": Wheels, "drive_stop_s": stop_s}}
    a, alice = robot(fleet, devices=devices), person(fleet)
    assert begin(alice).result["stop_after_s"] == stop_s
    drive(fleet, alice, 1.0, 0.4)
    fleet.crash("alice")
    silent_s = fleet.now() - 0.1
    fleet.run_for(SILENT_S - 0.5)
    assert newest() == (0.0, "")
    stopped_s = next(at_s for at_s, speed_mps, _ in Wheels.told["a"] if at_s > silent_s and speed_mps == 0.0)
    assert stop_s - 0.15 < stopped_s - silent_s < stop_s + 0.01
    assert goes_on(fleet)
    assert a.events("drive_ended")[0]["reason"] == "silent"


def test_driver_that_is_back_in_time_drives_on(fleet):
    robot(fleet)
    alice = person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    fleet.run_for(SILENT_S - 1.0)
    assert newest() == (0.0, "")
    drive(fleet, alice, 0.5, 0.4)
    assert newest() == (0.4, "a/device/drive-motors")


def test_command_that_a_link_delivers_after_the_stop_is_answered_and_not_obeyed(fleet):
    """The person may have let the key go meanwhile."""
    robot(fleet)
    alice = person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    fleet.run_for(STOP_S + 0.5)
    assert newest() == (0.0, "")
    reply = alice.ask(Drive("motors", "one", 0.4), to="a")
    assert reply.ok and reply.result["late"] is True
    fleet.run_for(STOP_S - 0.1)
    assert newest()[0] == 0.0
    reply = alice.ask(Drive("motors", "one", 0.3), to="a")
    assert reply.ok and reply.result["late"] is False
    fleet.run_for(0.1)
    assert newest() == (0.3, "a/device/drive-motors")
    fleet.run_for(STOP_S + 0.5)
    assert begin(alice, id="two", take=True, v_mps=0.2).ok, "what begins a drive is new"
    fleet.run_for(0.1)
    assert newest() == (0.2, "a/device/drive-motors")


def test_drive_that_is_over_does_not_begin_by_itself(fleet):
    robot(fleet)
    alice = person(fleet)
    begin(alice)
    fleet.run_for(SILENT_S + 1.0)
    reply = alice.ask(Drive("motors", "one", 0.4), to="a")
    assert reply.refusal.code == "conflict" and "is over" in reply.reason
    assert goes_on(fleet)


def test_second_driver_is_refused_and_may_take_over(fleet):
    a, alice, bob = robot(fleet), person(fleet), person(fleet, "bob")
    begin(alice)
    reply = begin(bob, id="two")
    assert reply.refusal.code == "conflict"
    assert reply.reason.startswith("alice drives motors by hand already") and "--take" in reply.reason
    assert bob.ask(EndDrive("motors", "two"), to="a").refusal.code == "conflict"
    drive(fleet, alice, 0.5, 0.4)
    assert begin(bob, id="two", take=True, dry_run=True).ok
    drive(fleet, alice, 0.5, 0.4)
    assert begin(bob, id="two", take=True).ok
    reply = alice.ask(Drive("motors", "one", 0.4), to="a")
    assert reply.refusal.code == "conflict" and reply.reason == "bob has taken over motors"
    assert alice.ask(EndDrive("motors", "one"), to="a").reason == "bob has taken over motors"
    drive(fleet, bob, 0.5, -0.2, "two")
    assert newest() == (-0.2, "a/device/drive-motors")
    assert a.events("drive_begun")[1]["taken_from"].startswith("alice/")
    assert bob.ask(EndDrive("motors", "two"), to="a").ok
    assert goes_on(fleet)


def test_agent_that_is_started_again_lets_the_holder_go_on(fleet):
    robot(fleet)
    alice = person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    fleet.crash("a")
    Wheels.told.clear()
    fleet.restart("a")
    assert goes_on(fleet)


@pytest.mark.parametrize(
    "ends",
    [Stop("device/drive-motors"), Restart("device/motors"), Restart("device/")],
    ids=["task", "device", "service"],
)
def test_holder_goes_on_if_something_else_ends_the_drive(fleet, ends):
    a, alice = robot(fleet), person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    assert a.ask(ends).ok
    fleet.run_for(SILENT_S + 2.0)
    assert goes_on(fleet)


def test_holder_that_wakes_itself_waits_all_the_same(fleet):
    a, alice = robot(fleet, task=Naps), person(fleet)
    begin(alice)
    turns = a.task("Count").state.turns
    drive(fleet, alice, 2.0, 0.4)
    assert a.task("Count").state.turns == turns
    alice.ask(EndDrive("motors", "one"), to="a")
    assert goes_on(fleet)


def test_task_that_wants_the_actuator_meanwhile_starts_after_the_drive(fleet):
    a, alice = robot(fleet), person(fleet)
    begin(alice)
    asked = a.publish("sysctrl", Restart("client/"), to="a")
    drive(fleet, alice, 3.0, 0.4)
    assert a.reply_to(asked).ok
    (row,) = [it for it in a.tasks() if it["task"] == "Count"]
    assert row["waits"] and row["reason"] == "alice drives motors by hand"
    assert newest() == (0.4, "a/device/drive-motors")
    alice.ask(EndDrive("motors", "one"), to="a")
    fleet.run_for(5.0)
    assert goes_on(fleet)


def test_waiting_task_migrates_and_runs_on_the_other_robot(fleet):
    a, alice = robot(fleet), person(fleet)
    robot(fleet, "b", tasks={}, classes={"test.Count": Count})
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    turns = a.task("Count").state.turns
    asked = a.publish("sysctrl", Migrate("Count", to="b"), to="a")
    drive(fleet, alice, 3.0, 0.4)
    assert a.reply_to(asked).ok
    assert newest() == (0.4, "a/device/drive-motors"), "the driver keeps the robot"
    assert goes_on(fleet, "b") and fleet.agents["b"].task("Count").state.turns > turns
    refused = fleet.agents["b"].ask(Migrate("Count", to="a"))
    assert not refused.ok and "alice drives motors by hand" in refused.reason


def test_task_of_another_agent_is_refused_meanwhile_and_goes_on(fleet):
    a = fleet.start("a", devices={"motors": Wheels})
    far = {"far": {"type": "network.motors", "settings": {"target": "a/device/motors"}}}
    fleet.start("b", devices=far, tasks={"Count": Count})
    alice = person(fleet)
    assert newest() == (0.1, "b/device/far")
    assert begin(alice).result["paused"] == ""
    drive(fleet, alice, 2.0, 0.4)
    assert newest() == (0.4, "a/device/drive-motors")
    assert {it["reason"] for it in a.events("command_refused")} == {"alice drives motors by hand"}
    alice.ask(EndDrive("motors", "one"), to="a")
    fleet.run_for(1.0)
    assert newest() == (0.1, "b/device/far")


def test_halt_counts_before_the_driver(fleet):
    a, alice = robot(fleet), person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    assert a.ask(Halt("a child")).ok
    reply = alice.ask(Drive("motors", "one", 0.4), to="a")
    assert not reply.ok and "a child" in reply.reason
    fleet.run_for(1.0)
    assert newest()[0] == 0.0
    assert not begin(alice, id="two").ok
    assert alice.ask(EndHalt(), to="a").ok
    fleet.run_for(SILENT_S)
    assert goes_on(fleet)


def test_commands_of_a_driver_pass_the_filters(fleet):
    slow = {"slow": {"type": "limit", "device": "motors", "settings": {"max_mps": 0.2}}}
    robot(fleet, filters=slow)
    alice = person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.8)
    assert newest() == (0.2, "a/device/drive-motors")
    (told,) = alice.ask(Drive("motors", "one", 0.8), to="a").result["filters"]
    assert told["filter"] == "slow" and told["doing"] == "changes"


@pytest.mark.parametrize("fields", [{"v_mps": float("nan")}, {"omega_radps": float("inf")}])
def test_velocity_that_is_no_number_is_refused(fleet, fields):
    robot(fleet)
    alice = person(fleet)
    assert begin(alice, **fields).refusal.code == "invalid"
    assert goes_on(fleet), "nothing has changed"


def test_what_takes_no_velocity_is_not_driven(fleet):
    robot(fleet)
    alice = person(fleet)
    for target, code in (("pose", "unsupported"), ("Count", "unsupported"), ("wings", "not_found")):
        assert alice.ask(Drive(target, "one", begin=True), to="a").refusal.code == code
    assert "motors can (--device)" in alice.ask(Drive("pose", "one", begin=True), to="a").reason
    assert begin(alice, dry_run=True).ok
    assert goes_on(fleet)


def test_driver_needs_the_right(fleet):
    a = robot(fleet, text='[access]\nrefuse = ["drive"]\n')
    alice = person(fleet)
    reply = begin(alice)
    assert reply.refusal.code == "forbidden" and "'drive'" in reply.reason
    assert begin(alice, dry_run=True).ok, "a dry run needs the right to look"
    assert a.ask(Drive("motors", "one", begin=True)).ok, "a task of the agent itself has all rights"


@pytest.mark.parametrize("again", [Restart, Start])
def test_drive_does_not_begin_again_without_its_driver(fleet, again):
    a, alice = robot(fleet), person(fleet)
    begin(alice, v_mps=0.4)
    reply = a.ask(again("device/drive-motors"))
    assert reply.refusal.code == "unsupported" and "pancakes drive" in reply.reason
    assert a.ask(Stop("device/drive-motors")).ok
    assert goes_on(fleet) and len(a.events("drive_begun")) == 1


def test_device_with_the_name_of_the_driving_task_stays_as_it_is(fleet):
    a, alice = robot(fleet, devices={"motors": Wheels, "drive-motors": {"type": Place, "rate_hz": 1}}), person(fleet)
    reply = begin(alice)
    assert reply.refusal.code == "unsupported" and "another name" in reply.reason
    (place,) = [it for it in a.tasks() if it["task"] == "drive-motors"]
    assert place["state"] == "running" and a.events("task_failed", task="drive-motors") == []
    assert goes_on(fleet)


def test_halt_that_ends_at_once_does_not_let_the_newest_command_go_on(fleet):
    devices = {"motors": {"type": Wheels, "drive_stop_s": 4.0}}
    a, alice = robot(fleet, devices=devices), person(fleet)
    begin(alice)
    drive(fleet, alice, 0.5, 0.4)
    assert a.ask(Halt("a child")).ok
    fleet.run_for(0.5)
    assert alice.ask(EndHalt(), to="a").ok
    fleet.run_for(1.0)
    assert newest()[0] == 0.0
    drive(fleet, alice, 0.5, 0.4)
    assert newest() == (0.4, "a/device/drive-motors")


def test_restart_of_a_task_that_waits_is_foreseen(fleet):
    a, alice = robot(fleet), person(fleet)
    begin(alice)
    reply = a.ask(Restart("Count", dry_run=True))
    assert not reply.ok and reply.reason == "alice drives motors by hand"


def test_holder_goes_on_even_if_the_drive_fails_to_hold(fleet, monkeypatch):
    a, alice = robot(fleet), person(fleet)
    begin(alice)

    def fails(self, *args, **others):
        raise MailboxFullError("no room")

    monkeypatch.setattr(HandDrive, "publish", fails)
    alice.ask(EndDrive("motors", "one"), to="a")
    assert goes_on(fleet)
    assert a.kernel.registry.loan("motors") is None


def test_virtual_actuator_is_driven_as_any_other(fleet):
    fleet.start("a", devices={"motors": Wheels})
    far = {"far": {"type": "network.motors", "settings": {"target": "a/device/motors"}}}
    fleet.start("b", devices=far, tasks={"Count": Count})
    alice, bob = person(fleet), person(fleet, "bob")
    assert alice.ask(Drive("far", "one", begin=True), to="b").result["paused"] == "b/client/Count"
    for _ in range(5):
        assert alice.ask(Drive("far", "one", 0.4), to="b").ok
        fleet.run_for(0.1)
    assert newest() == (0.4, "b/device/far")
    assert begin(bob, id="two").ok
    drive(fleet, bob, 0.5, -0.2, "two")
    assert newest() == (-0.2, "a/device/drive-motors"), "of two, the one at the wheels themselves drives"
    fleet.run_for(SILENT_S + 1.0)
    assert newest() == (0.1, "b/device/far")


def test_flood_of_commands_does_not_put_off_the_stop(fleet):
    a, alice = robot(fleet), person(fleet)
    begin(alice)
    asked = [alice.publish("sysctrl", Drive("motors", "one", 0.4), to="a") for _ in range(2000)]
    fleet.run_for(STOP_S + 0.2)
    assert newest()[0] == 0.0
    assert any(alice.reply_to(it) is not None for it in asked)
    fleet.run_for(SILENT_S)
    assert goes_on(fleet)
    assert len(a.events("drive_begun")) == len(a.events("drive_ended")) == 1
