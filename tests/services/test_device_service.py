"""Devices: sampled, held by one task at a time, brought to their safe hold, and virtual where they are elsewhere."""

import threading
from dataclasses import dataclass

import pytest

from pancakes.control import Configure, Describe, Hold, Reschedule, Restart, Start, Stop
from pancakes.devices import Battery, Load, Pose, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.events import Event
from pancakes.packet import Fence, Packet
from pancakes.services.device import SharedThings
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, assert_published


class Thermometer(Sensor):
    """Counts its readings; fails as its settings say."""

    type = "load"

    @dataclass
    class Settings:
        first: float = 0.0
        fail_at_open: bool = False
        fail_after: int = 1_000_000

    opened = 0
    closed = 0

    def open(self):
        type(self).opened += 1
        self.readings = 0
        if self.settings.fail_at_open:
            raise OSError("no such port")

    def read(self):
        self.readings += 1
        if self.readings > self.settings.fail_after:
            raise OSError("unplugged")
        return Load(self.settings.first + self.readings)

    def close(self):
        type(self).closed += 1


class Wheels(Actuator):
    """Writes down what it is told."""

    type = "motors"
    told: list

    def open(self):
        type(self).told = []

    def write(self, command, ttl_s, source):
        self.told.append((round(self.context.now(), 3), command.v_mps, source.rpartition("/")[2]))

    def safe_stop(self):
        self.told.append((round(self.context.now(), 3), "hold"))

    def close(self):
        self.told.append((round(self.context.now(), 3), "close"))


class Driving(Task):
    """Drives at 10 Hz as fast as its settings say, until it stops by itself."""

    requires = ("motors",)

    @dataclass
    class Settings:
        v_mps: float = 0.1
        until_s: float = 1e9

    @every(hz=10)
    def drive(self, tick):
        if tick.time_s < self.settings.until_s:
            self.publish("ctrl", Twist(self.settings.v_mps, 0.0))


class Meddling(Task):
    """Commands wheels that it never asked for."""

    @every(hz=5)
    def meddle(self, tick):
        self.publish("ctrl", Twist(9.0, 0.0))


def test_two_drivers_that_open_together_share_one_thing():
    things, asked, got = SharedThings(), threading.Event(), []
    made: list[object] = []

    def make():
        assert asked.wait(10.0)
        made.append(Closing())
        return made[-1]

    class Closing:
        closed = False

        def close(self):
            self.closed = True

    threads = [threading.Thread(target=lambda: got.append(things.get("bus", make))) for _ in range(2)]
    for thread in threads:
        thread.start()
    asked.set()
    for thread in threads:
        thread.join(10.0)
    assert got == made * 2 and len(made) == 1
    things.close()
    assert got[0].closed


def test_a_thing_that_could_not_be_made_is_made_for_the_next_driver_that_asks():
    things = SharedThings()
    with pytest.raises(ZeroDivisionError):
        things.get("bus", lambda: 1 // 0)
    assert things.get("bus", lambda: "the bus") == "the bus"


@pytest.fixture(autouse=True)
def counters():
    Thermometer.opened = Thermometer.closed = 0


@pytest.fixture
def fleet():
    with Fleet(seed=2) as made:
        yield made


# Sensors -------------------------------------------------------------------------------------------------------


def test_a_sensor_is_sampled_at_its_rate_and_publishes_on_system(fleet):
    agent = fleet.start("a", devices={"cpu": {"type": Thermometer, "rate_hz": 4.0, "settings": {"first": 10.0}}})
    fleet.run_for(2.0)
    readings = agent.probe.packets(Load, channel="system", source="a/device/cpu")
    assert [packet.body.cpu for packet in readings] == [10.0 + n for n in range(1, 9)]


class Confused(Sensor):
    """Says that it brings a load, and brings a pose."""

    type = "load"

    def read(self):
        return Pose(0.0, 0.0, 0.0)


class ConfusedByItself(Confused):
    rate = "none"

    def open(self):
        self.context.deliver(Pose(0.0, 0.0, 0.0))


@pytest.mark.parametrize(("driver", "rate"), [(Confused, {"rate_hz": 1.0}), (ConfusedByItself, {})])
def test_a_reading_of_another_class_is_named_with_both_and_never_published(fleet, driver, rate):
    agent = fleet.start("a", devices={"cpu": {"type": driver, **rate}})
    fleet.run_for(3.0)
    why = f"{driver.__name__} brings a Pose, and its type is 'load', whose readings are each a Load"
    assert [line for line in agent.lines("warning") if why in line] == [f"cpu: a reading is missed: {why}"]
    assert agent.probe.packets(Pose) == []


def test_its_rate_is_changed_by_a_packet(fleet):
    agent = fleet.start("a", devices={"cpu": {"type": Thermometer, "rate_hz": 4.0}})
    assert agent.ask(Reschedule("device/cpu", 1.0)).ok
    agent.probe.forget()
    fleet.run_for(4.0)
    assert_published(agent, Load, times=4)


def test_the_settings_of_its_driver_are_changed_by_a_packet_and_stay(fleet):
    agent = fleet.start("a", devices={"cpu": {"type": Thermometer, "rate_hz": 4.0, "settings": {"first": 10.0}}})
    assert agent.ask(Configure("cpu", {"first": 100.0})).ok
    assert agent.ask(Configure("cpu", {"frist": 100.0})).reason.endswith("unknown key, did you mean 'first'?")
    agent.probe.forget()
    fleet.run_for(0.5)
    assert [packet.body.cpu for packet in agent.probe.packets(Load)] == [101.0, 102.0]
    assert agent.ask(Restart("device")).ok
    assert agent.ask(Describe("cpu")).result["settings"]["first"] == 100.0
    assert agent.ask(Restart("cpu", keep_state=False)).ok
    assert agent.ask(Describe("cpu")).result["settings"]["first"] == 10.0
    assert Thermometer.opened == Thermometer.closed + 1 == 4


def test_settings_that_its_driver_cannot_open_with_are_told_and_it_goes_on_with_the_former(fleet):
    agent = fleet.start("a", devices={"cpu": {"type": Thermometer, "rate_hz": 4.0}})
    reply = agent.ask(Configure("cpu", {"fail_at_open": True}))
    assert not reply.ok
    assert "OSError: no such port" in reply.reason
    fleet.run_for(0.1)
    assert agent.ask(Describe("cpu")).result["settings"]["fail_at_open"] is False
    assert agent.ask(Describe("cpu")).result["state"] == "running"


def test_a_sensor_without_a_rate_is_not_sampled(fleet):
    agent = fleet.start("a", devices={"cpu": Thermometer})
    fleet.run_for(4.0)
    assert_published(agent, Load, times=0)


def test_a_driver_that_fails_is_opened_anew_and_goes_on(fleet):
    device = {"type": Thermometer, "rate_hz": 4.0, "settings": {"fail_after": 6}, "missed": {"in_a_row": 1}}
    agent = fleet.start("a", devices={"cpu": device})
    fleet.run_for(5.0)
    assert [event["then"] for event in agent.events("task_failed", task="cpu")] == ["restart", "restart"]
    assert "OSError: unplugged" in agent.events("task_failed")[0]["error"]
    assert Thermometer.opened == Thermometer.closed + 1 == 3
    assert agent.kernel.registry.device_types() == ["load"]


def test_a_driver_that_fails_again_while_it_is_closed_for_that_says_both(fleet):
    class Broken(Thermometer):
        def read(self):
            raise OSError("unplugged")

        def close(self):
            raise OSError("gone")

    agent = fleet.start("a", devices={"cpu": {"type": Broken, "rate_hz": 4.0, "missed": {"in_a_row": 1}}})
    fleet.run_for(0.3)
    assert agent.events("task_failed")[0]["error"].startswith("OSError: unplugged at test_device_service.py:")
    (told,) = agent.lines("error")
    again = (
        "on_failure of a/device/cpu failed as well: OSError: gone (from OSError: unplugged) at test_device_service.py:"
    )
    assert told.startswith(again)


def test_a_driver_that_fails_in_open_is_given_up_and_the_agent_runs(fleet):
    spec = {"type": Thermometer, "settings": {"fail_at_open": True}, "restart": {"at_most": 2, "within_s": 5}}
    agent = fleet.start("a", devices={"cpu": spec}, tasks={"Meddling": Meddling})
    fleet.run_for(1.0)
    assert [event["then"] for event in agent.events("task_failed", task="cpu")] == ["restart", "restart", "give up"]
    assert Thermometer.opened == Thermometer.closed == 3
    assert agent.kernel.registry.devices() == []
    assert agent.running() == ["Meddling"]


def test_bad_settings_of_a_driver_are_told(fleet):
    agent = fleet.start("a", devices={"cpu": {"type": Thermometer, "settings": {"frist": 1.0}}})
    assert "frist: unknown key, did you mean 'first'?" in agent.events("task_given_up", task="cpu")[0]["error"]


def test_a_task_whose_device_is_missing_is_refused_with_a_sentence(fleet):
    agent = fleet.start("a", tasks={"Driving": Driving})
    sentence = "a lacks the device types motors, which Driving requires"
    assert any(sentence in line for line in agent.lines("error"))
    refused = agent.ask(Start("Driving"))
    assert (refused.ok, refused.reason) == (False, sentence)


def test_a_task_whose_device_was_given_up_may_start_once_it_is_there_again(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    assert agent.ask(Stop("device/wheels")).ok
    agent.ask(Stop("Driving"))
    assert not agent.ask(Start("Driving")).ok
    assert agent.ask(Start("device/wheels")).ok
    assert agent.ask(Start("Driving")).ok


def test_a_task_that_fails_while_its_device_is_away_can_be_started_later(fleet):
    class Fragile(Driving):
        @on("system", Battery)
        def fail(self, packet):
            raise RuntimeError("flat")

    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Fragile})
    assert agent.ask(Stop("device/wheels")).ok
    agent.publish("system", Battery(0.0, 0.0))
    fleet.run_for(1.0)
    assert agent.running() == []
    assert agent.kernel.registry.held_by("a/client/Driving") == []
    assert agent.ask(Start("device/wheels")).ok
    assert agent.ask(Start("Driving")).ok
    assert agent.running() == ["Driving"]


# Actuators -----------------------------------------------------------------------------------------------------


def test_an_actuator_obeys_the_task_that_holds_it(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    fleet.run_for(0.35)
    # The first waits until the epoch of its task is on disk.
    assert Wheels.told == [(0.102, 0.1, "Driving"), (0.2, 0.1, "Driving"), (0.3, 0.1, "Driving")]
    assert agent.ask(Describe("wheels")).result["holder"] == "a/client/Driving"


def test_an_actuator_with_a_rate_is_called_at_it(fleet):
    class Blinking(Wheels):
        def tick(self):
            self.told.append((round(self.context.now(), 3), "tick"))

    fleet.start("a", devices={"lamp": {"type": Blinking, "rate_hz": 2.0}})
    fleet.run_for(1.1)
    assert Blinking.told == [(0.5, "tick"), (1.0, "tick")]


def test_another_tasks_commands_are_refused_and_told_once(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving, "Meddling": Meddling})
    fleet.run_for(3.0)
    assert all(told[1] == 0.1 for told in Wheels.told)
    refused = agent.events("command_refused")
    assert {(event["device"], event["by"], event["reason"]) for event in refused} == {
        ("wheels", "a/client/Meddling", "it is held by a/client/Driving")
    }
    assert len(refused) == 1
    assert len([line for line in agent.lines("warning") if "refused a command" in line]) == 1


def test_an_actuator_that_nobody_holds_obeys_nobody(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Meddling": Meddling})
    fleet.run_for(1.0)
    assert Wheels.told == []
    assert agent.events("command_refused")[0]["reason"] == "a/client/Meddling does not hold it"


def test_two_tasks_cannot_hold_one_actuator(fleet):
    agent = fleet.start(
        "a", devices={"wheels": Wheels}, tasks={"One": Driving, "Two": {"type": Driving, "start": False}}
    )
    assert agent.ask(Start("Two")).reason == "wheels is held by a/client/One"
    assert agent.ask(Stop("One")).ok
    assert agent.ask(Start("Two")).ok
    assert agent.ask(Start("One")).reason == "wheels is held by a/client/Two"


def test_without_a_fresh_command_it_goes_to_its_safe_hold(fleet):
    wheels = {"type": Wheels, "hold_after_mission_s": 0.5}
    agent = fleet.start(
        "a", devices={"wheels": wheels}, tasks={"Driving": {"type": Driving, "settings": {"until_s": 1.05}}}
    )
    fleet.run_for(5.0)
    assert Wheels.told[-2:] == [(1.0, 0.1, "Driving"), (1.5, "hold")]
    assert agent.events("safe_hold") == [{"kind": "safe_hold", "device": "wheels", "reason": "no fresh command"}]


def test_when_its_task_stops_it_holds_at_once(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    fleet.run_for(0.45)
    assert agent.ask(Stop("Driving")).ok
    fleet.run_for(0.01)
    assert Wheels.told[-1] == (pytest.approx(0.45, abs=0.01), "hold")
    fleet.run_for(5.0)
    assert [event["reason"] for event in agent.events("safe_hold")] == ["Driving let go of it"], "once"


def test_a_hold_stops_the_device_that_it_names_and_one_that_names_none_stops_none(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels, "cpu": Thermometer}, tasks={"Driving": Driving})
    fleet.run_for(0.45)
    agent.publish("ctrl", Hold("to all"))
    agent.publish("ctrl", Hold("to another"), to="a/device/cpu")
    fleet.run_for(0.01)
    assert agent.events("safe_hold") == []
    agent.publish("ctrl", Hold("to the wheels"), to="a/device/wheels")
    fleet.run_for(0.01)
    assert [event["reason"] for event in agent.events("safe_hold")] == ["to the wheels"]


def test_when_its_task_fails_for_good_it_holds_at_once(fleet):
    class Crashing(Driving):
        @on("system", Battery)
        def fail(self, packet):
            raise RuntimeError("flat")

    spec = {"type": Crashing, "restart": {"policy": "no"}}
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": spec})
    fleet.run_for(0.45)
    agent.publish("system", Battery(0.0, 0.0))
    fleet.run_for(0.01)
    assert Wheels.told[-1] == (pytest.approx(0.45, abs=0.01), "hold")
    assert agent.kernel.registry.holder("wheels") == ""


def test_when_the_device_stops_it_holds_and_is_closed(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    fleet.run_for(0.45)
    assert agent.ask(Stop("wheels")).ok
    assert [told[1] for told in Wheels.told[-2:]] == ["hold", "close"]


def test_a_driver_that_cannot_hold_is_closed_all_the_same(fleet):
    class Bad(Wheels):
        def safe_stop(self):
            raise OSError("unplugged")

    agent = fleet.start("a", devices={"wheels": Bad})
    assert agent.ask(Stop("wheels")).ok
    assert [told[1] for told in Bad.told] == ["close"]
    assert any("unplugged" in line for line in agent.lines("warning"))


def test_a_task_that_is_restarted_keeps_what_it_holds(fleet):
    agent = fleet.start("a", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    assert agent.ask(Restart("Driving")).ok
    assert agent.kernel.registry.holder("wheels") == "a/client/Driving"


def command(epoch, source="a/client/Driving", seq=1, v_mps=0.5):
    fence = Fence("b/Driving", epoch)
    return Packet("ctrl", "motors", source, "", 0.0, seq, Twist(v_mps, 0.0), fence=fence)


def test_commands_of_an_epoch_that_has_passed_are_refused(fleet):
    """A copy of the task that lost its right elsewhere, and does not know it yet, moves no wheel."""
    agent = fleet.start(
        "a", devices={"wheels": Wheels}, tasks={"Driving": {"type": Driving, "settings": {"until_s": 0.0}}}
    )
    for epoch, v_mps in (((2, "b"), 0.2), ((1, "c"), 0.1), ((2, "a"), 0.3), ((3, "a"), 0.4)):
        agent.kernel.stream.publish(command(epoch, v_mps=v_mps))
        fleet.run_for(0.01)
    assert [told[1] for told in Wheels.told] == [0.2, 0.4]
    assert "epoch 1 of b/Driving has passed, 2 has been seen" in agent.events("command_refused")[0]["reason"]


# Virtual devices -----------------------------------------------------------------------------------------------


class Capture(Task):
    """Sends another agent its pose, as a motion capture does."""

    @every(hz=10)
    def send(self, tick):
        self.publish("system", Pose(tick.time_s, 0.0, 0.0), to="a/device/pose")


def test_a_virtual_sensor_gives_an_agent_what_another_one_measures(fleet):
    class Steering(Task):
        requires = ("pose",)

        @on("system", Pose, queue="latest")
        def pose(self, packet):
            self.event("saw", x_m=packet.body.x_m, source=packet.source)

    agent = fleet.start("a", devices={"pose": "network.pose"}, tasks={"Steering": Steering})
    world = fleet.start("world", tasks={"Capture": Capture}, role="environment")
    fleet.run_for(3.0)
    seen = agent.events("saw")
    assert len(seen) >= 20
    assert {event["source"] for event in seen} == {"a/device/pose"}
    assert [event["x_m"] for event in seen] == sorted(event["x_m"] for event in seen)
    # At the world itself nothing of this is published.
    assert world.probe.packets(Pose) == []


def test_a_virtual_sensor_that_hears_nothing_says_so_once(fleet):
    agent = fleet.start("a", devices={"pose": {"type": "network.pose", "silent_mission_s": 1.0}})
    fleet.run_for(10.0)
    assert len([line for line in agent.lines("warning") if "no reading has come" in line]) == 1


def test_a_virtual_actuator_drives_another_agents_wheels(fleet):
    """The wheels of an agent that nobody there holds may be held from elsewhere, by one at a time."""
    far = fleet.start("far", devices={"wheels": Wheels})
    remote = {"type": "network.motors", "settings": {"target": "far/device/wheels"}}
    near = fleet.start(
        "near",
        devices={"wheels": remote},
        tasks={"Driving": {"type": Driving, "start": False, "settings": {"v_mps": 0.3}}},
    )
    fleet.connect()
    assert near.ask(Start("Driving")).ok
    fleet.run_for(1.0)
    assert [told[1:] for told in Wheels.told[:5]] == [(0.3, "wheels")] * 5
    assert far.kernel.registry.holder("wheels") == "near/device/wheels"
    assert near.ask(Stop("Driving")).ok
    fleet.run_for(0.1)
    assert Wheels.told[-1][1] == "hold"
    assert far.kernel.registry.holder("wheels") == ""


def test_wheels_that_a_task_holds_here_do_not_obey_from_elsewhere(fleet):
    fleet.start("far", devices={"wheels": Wheels}, tasks={"Driving": Driving})
    remote = {"type": "network.motors", "settings": {"target": "far/device/wheels"}}
    near = fleet.start(
        "near", devices={"wheels": remote}, tasks={"Remote": {"type": Driving, "settings": {"v_mps": 0.3}}}
    )
    fleet.connect()
    fleet.run_for(1.0)
    assert {told[1] for told in Wheels.told} == {0.1}
    # Nor do they stop because somebody elsewhere says so.
    near.publish("ctrl", Hold("a stranger says so"), to="far/device/wheels")
    fleet.run_for(0.5)
    assert {told[1] for told in Wheels.told} == {0.1}


def test_the_rate_of_discovery_is_a_tasks_rate_like_any_other(fleet):
    """What the paper's BatteryWatchdog does when power is short: it slows the beacons by a control packet."""

    class Watchdog(Task):
        @on("system", Battery)
        def battery(self, packet):
            if packet.body.level < 0.9:
                self.publish("sysctrl", Reschedule("network/Discovery", 0.5))

    fleet.start("b")
    agent = fleet.start("a", tasks={"Watchdog": Watchdog})
    fleet.connect()

    def beacons_in(duration_s):
        announced = []
        announce = agent.agent.mesh.announce
        agent.agent.mesh.announce = lambda: announced.append(announce())
        fleet.run_for(duration_s)
        agent.agent.mesh.announce = announce
        return len(announced)

    assert beacons_in(10.0) == 10
    agent.publish("system", Battery(11.0, 0.89))
    fleet.run_for(0.0)
    assert beacons_in(10.0) == 5
    assert assert_published(agent, Event, lambda event: event.kind == "rate_changed").body.fields["rate_hz"] == 0.5


def test_only_an_actuator_says_whether_it_holds_by_itself():
    with Fleet(1) as fleet:
        agent = fleet.start("a", devices={"motors": "null.motors", "pose": "null.pose"})
        assert "watchdog_s" in agent.ask(Describe("motors")).result
        assert "watchdog_s" not in agent.ask(Describe("pose")).result
