"""What failed is tried again after a growing pause: tasks, devices and services, and what a person asks meanwhile."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pancakes.control import Configure, Describe, Restart, Start, Stop
from pancakes.devices import Load
from pancakes.devices.driver import Sensor
from pancakes.service import Service
from pancakes.task import Task, TaskSpec, every
from pancakes.testing import Fleet, threaded_agent


class Gauge(Sensor):
    """Reads a file, which must be there when it is opened."""

    type = "load"

    @dataclass
    class Settings:
        path: str = ""

    def open(self):
        self.file = Path(self.settings.path).open()  # noqa: SIM115 - closed by `close`

    def read(self):
        return Load(1.0)

    def close(self):
        if hasattr(self, "file"):
            self.file.close()


class Reader(Task):
    """Needs the gauge."""

    requires = ("load",)


class Opener(Task):
    """Opens a file in its start."""

    @dataclass
    class Settings:
        path: str = ""

    def on_start(self):
        Path(self.settings.path).read_text()


class Plain(Service):
    """A service whose tasks are not durable."""


class Camera(Service):
    """A service that opens a file in its start, and has a task."""

    @dataclass
    class Settings:
        path: str = ""

    def own_tasks(self):
        return [TaskSpec("Lens", Task, settings={})]

    def on_start(self):
        Path(self.settings.path).read_text()


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        yield made


@pytest.fixture
def path(tmp_path):
    """The file that is missing until a test writes it."""
    return tmp_path / "ttyUSB0"


class Thing:
    """What fails while a file is missing: a device, a task of either kind of service, or a service.

    Attributes:
        target: what control packets name.
    """

    def __init__(self, kind, fleet, path, restart):
        self.fleet = fleet
        self.kind = kind
        parts = {"settings": {"path": str(path)}, "restart": restart}
        self.target = {"device": "device/thing", "service": "thing"}.get(kind, f"{kind}/thing")
        match kind:
            case "device":
                self.agent = fleet.start("a", devices={"thing": {"type": Gauge, "rate_hz": 10.0, **parts}})
            case "service":
                self.agent = fleet.start("a", services={"thing": {"type": Camera, **parts}})
            case _:
                tasks = {"thing": {"type": Opener, "service": kind, **parts}}
                self.agent = fleet.start("a", tasks=tasks, services={"plain": Plain})

    def row(self):
        """What the agent says of it."""
        (row,) = (
            row
            for row in self.agent.ask(Describe()).result["services" if self.kind == "service" else "tasks"]
            if row["service" if self.kind == "service" else "task"] == "thing"
        )
        return row

    def state(self):
        return self.row()["state"]

    def failures(self):
        """How often it has failed in all."""
        kind, key = ("service_failed", "service") if self.kind == "service" else ("task_failed", "task")
        return len(self.agent.events(kind, **{key: "thing"}))


@pytest.fixture(params=["device", "client", "plain", "service"])
def thing(request, fleet, path):
    def make(**restart):
        return Thing(request.param, fleet, path, restart)

    return make


def test_what_it_needs_comes_a_second_after_the_start_and_is_found(thing, fleet, path):
    it = thing()
    assert it.state() == "restarting"  # and the agent is ready: the rest of it does not wait
    fleet.run_for(1.0)
    assert it.state() == "restarting"
    path.write_text("")
    fleet.run_for(1.0)
    assert it.state() == "running"
    assert not any("given up" in line for line in it.agent.lines("error"))


def test_the_pauses_grow_and_a_fault_that_stays_is_given_up(thing, fleet):
    it = thing(at_most=5, again_s=0.0)
    for _ in range(200):
        fleet.run_for(0.02)
    assert it.state() == "failed"
    assert it.failures() == 6
    assert it.row()["failures"] == 6 and it.row()["next_try_s"] is None
    kind = "service_failed" if it.kind == "service" else "task_failed"
    stamps = [
        packet.stamp_s for packet in it.agent.probe.packets(channel="log") if getattr(packet.body, "kind", "") == kind
    ]
    pauses_s = [after - before for before, after in zip(stamps, stamps[1:], strict=False)]
    for found_s, most_s in zip(pauses_s, (0.1, 0.2, 0.4, 0.8, 1.6), strict=True):
        assert 0.75 * most_s <= found_s <= most_s + 0.01
    fleet.run_for(300.0)
    assert it.failures() == 6


def test_it_says_how_often_it_failed_and_when_the_next_try_is(thing, fleet):
    it = thing(pause_s=4.0)
    row = it.row()
    assert row["failures"] == 1
    assert 2.9 < row["next_try_s"] <= 4.0
    before_s = row["next_try_s"]
    fleet.run_for(1.0)
    assert it.row()["next_try_s"] == pytest.approx(before_s - 1.0, abs=0.01)
    assert any(f"is started again in {before_s:.1f} s" in line for line in it.agent.lines("warning"))


def test_what_was_given_up_is_tried_again_where_that_is_set(thing, fleet, path):
    it = thing(at_most=1, again_s=30.0)
    fleet.run_for(1.0)
    assert it.state() == "failed"
    assert 20.0 < it.row()["next_try_s"] < 30.0
    assert any("is given up, and tried again in " in line for line in it.agent.lines("error"))
    fleet.run_for(65.0)
    assert 4 <= it.failures() <= 5
    path.write_text("")
    fleet.run_for(30.0)
    assert it.state() == "running"
    assert it.row()["next_try_s"] is None


def test_a_stop_while_it_waits_calls_the_next_try_off(thing, fleet, path):
    it = thing(pause_s=2.0)
    assert it.agent.ask(Stop(it.target)).ok
    assert (it.state(), it.row()["next_try_s"]) == ("stopped", None)
    path.write_text("")
    fleet.run_for(120.0)
    assert it.state() == "stopped"
    assert it.agent.ask(Start(it.target)).ok
    assert it.state() == "running"


def test_a_stop_after_it_was_given_up_calls_the_next_try_off(thing, fleet, path):
    it = thing(at_most=0, again_s=5.0)
    assert it.state() == "failed"
    assert it.agent.ask(Stop(it.target)).ok
    assert (it.state(), it.row()["next_try_s"]) == ("stopped", None)
    path.write_text("")
    fleet.run_for(20.0)
    assert it.state() == "stopped"


def test_what_was_given_up_for_good_is_stopped_after_a_stop(thing):
    it = thing(policy="no", again_s=0.0)
    assert it.state() == "failed"
    assert it.agent.ask(Stop(it.target, dry_run=True)).ok and it.state() == "failed"
    assert it.agent.ask(Stop(it.target)).ok
    assert it.state() == "stopped" and it.row().get("rest", "") in ("", "stopped")
    assert not it.agent.ask(Stop(it.target)).ok


def test_what_was_given_up_before_a_reboot_is_stopped_after_a_stop(fleet, path):
    it = Thing("client", fleet, path, {"policy": "no"})
    assert it.state() == "failed"
    fleet.run_for(1.0)
    fleet.crash("a")
    it.agent = fleet.restart("a")
    assert it.row()["rest"] == "failed"
    assert it.agent.ask(Stop(it.target)).ok
    assert (it.state(), it.row()["rest"]) == ("stopped", "stopped")
    fleet.run_for(1.0)
    fleet.crash("a")
    it.agent = fleet.restart("a")
    assert (it.state(), it.row()["rest"]) == ("stopped", "stopped")


@pytest.mark.parametrize("body", [Start, Restart])
@pytest.mark.parametrize("restart", [{"pause_s": 9.0}, {"at_most": 0, "again_s": 9.0}])
def test_a_start_while_it_waits_is_tried_at_once_and_once_only(thing, fleet, path, body, restart):
    it = thing(**restart)
    refused = it.agent.ask(body(it.target))
    assert not refused.ok and "No such file" in refused.reason
    assert (it.failures(), it.row()["failures"]) == (2, 1)
    path.write_text("")
    asked_s = fleet.now()
    assert it.agent.ask(body(it.target)).ok
    assert fleet.now() - asked_s < 1.0
    assert it.state() == "running"
    fleet.run_for(20.0)
    kind = "service_started" if it.kind == "service" else "task_started"
    assert len([event for event in it.agent.events(kind) if "thing" in (event.get("task"), event.get("service"))]) >= 1
    assert it.failures() == 2
    assert it.state() == "running"


def test_a_start_with_other_settings_while_it_waits_takes_these(fleet, path, tmp_path):
    """As where a driver looks for its hardware at the wrong port."""
    other = tmp_path / "ttyUSB1"
    other.write_text("")
    for kind in ("device", "client", "plain"):
        with Fleet(seed=4) as another:
            it = Thing(kind, another, path, {"pause_s": 5.0})
            assert not it.agent.ask(Configure(it.target, {"path": str(other)})).ok
            assert it.agent.ask(Start(it.target, {"path": str(other)})).ok
            assert it.agent.ask(Describe(it.target)).result["settings"]["path"] == str(other)
            another.run_for(20.0)
            assert it.state() == "running"


def test_a_dry_run_changes_nothing_while_it_waits(thing, fleet):
    it = thing(pause_s=5.0)
    it.agent.ask(Start(it.target, dry_run=True))
    assert it.agent.ask(Stop(it.target, dry_run=True)).ok
    assert it.state() == "restarting"
    assert it.failures() == 1


def test_an_agent_that_ends_while_it_waits_ends_at_once(thing, fleet):
    it = thing(pause_s=600.0, pause_max_s=600.0)
    began_s = fleet.now()
    fleet.stop("a")
    assert fleet.now() - began_s < 1.0
    assert it.agent.still_running() == []


def test_what_runs_again_for_long_enough_has_all_its_tries_again(thing, fleet, path):
    it = thing(at_most=2, within_s=5.0, pause_s=1.0)
    fleet.run_for(0.5)
    path.write_text("")
    fleet.run_for(10.0)
    assert it.state() == "running"
    path.unlink()
    assert not it.agent.ask(Restart(it.target)).ok
    assert it.row()["failures"] == 1


# Devices -------------------------------------------------------------------------------------------------------


def test_a_device_that_was_given_up_is_tried_again_each_minute_by_default(fleet, path):
    agent = fleet.start("a", devices={"gauge": {"type": Gauge, "rate_hz": 1.0, "settings": {"path": str(path)}}})
    fleet.run_for(40.0)
    assert agent.ask(Describe("gauge")).result["state"] == "failed"
    path.write_text("")
    fleet.run_for(60.0)
    assert agent.ask(Describe("gauge")).result["state"] == "running"


def test_a_device_with_wrong_settings_is_given_up_at_once_and_for_good(fleet):
    agent = fleet.start("a", devices={"gauge": {"type": Gauge, "settings": {"paht": "x"}}})
    told = agent.ask(Describe("gauge")).result
    assert (told["state"], told["next_try_s"]) == ("failed", None)


def test_a_task_follows_once_the_device_that_it_requires_is_there(fleet, path):
    gauge = {"type": Gauge, "rate_hz": 1.0, "settings": {"path": str(path)}}
    agent = fleet.start("a", devices={"gauge": gauge}, tasks={"Reader": Reader})
    told = agent.ask(Describe("Reader")).result
    assert (told["state"], told["reason"]) == ("stopped", "a lacks the device types load, which Reader requires")
    fleet.run_for(1.0)
    path.write_text("")
    fleet.run_for(3.0)
    assert agent.running() == ["Reader"]
    assert agent.ask(Stop("Reader")).ok
    fleet.run_for(3.0)
    assert agent.running() == []


def test_a_task_that_waits_for_a_device_and_is_stopped_does_not_follow(fleet, path):
    gauge = {"type": Gauge, "rate_hz": 1.0, "settings": {"path": str(path)}}
    agent = fleet.start("a", devices={"gauge": gauge}, tasks={"Reader": Reader})
    assert agent.ask(Stop("Reader")).ok
    path.write_text("")
    fleet.run_for(5.0)
    assert agent.running("device") == ["gauge"]
    assert agent.running() == []


# Disks and clocks ----------------------------------------------------------------------------------------------


def test_a_task_that_waits_is_tried_again_by_an_agent_that_starts_anew(fleet, path):
    tasks = {"Opener": {"type": Opener, "settings": {"path": str(path)}, "restart": {"at_most": 0, "again_s": 60.0}}}
    agent = fleet.start("a", tasks=tasks)
    assert agent.ask(Describe("Opener")).result["state"] == "failed"
    fleet.run_for(1.0)
    fleet.crash("a")
    path.write_text("")
    assert fleet.restart("a").running() == ["Opener"]


def test_pauses_pass_in_host_time_whatever_the_speed_of_the_mission(fleet, path):
    tasks = {"Opener": {"type": Opener, "settings": {"path": str(path)}, "restart": {"pause_s": 4.0}}}
    agent = fleet.start("a", tasks=tasks, speed=100.0)
    fleet.run_for(2.0)
    assert len(agent.events("task_failed")) == 1
    fleet.run_for(3.0)
    assert len(agent.events("task_failed")) == 2


def test_the_same_seed_gives_the_same_pauses(path):
    def stamps(seed):
        with Fleet(seed) as fleet:
            agent = fleet.start("a", tasks={"Opener": {"type": Opener, "settings": {"path": str(path)}}}, seed=seed)
            fleet.run_for(30.0)
            return [(packet.stamp_s, packet.body) for packet in agent.probe.packets(channel="log")]

    assert stamps(1) == stamps(1)
    assert stamps(1) != stamps(2)


def test_the_same_on_threads(path):
    gauge = {"type": Gauge, "rate_hz": 50.0, "settings": {"path": str(path)}}
    with threaded_agent(devices={"gauge": gauge}, tasks={"Reader": Reader}) as agent:
        agent.wait_until(lambda: len(agent.events("task_failed", task="gauge")) >= 3)
        path.write_text("")
        agent.wait_for(Load)
        agent.wait_for_event("task_started", task="Reader")


# What is asked meanwhile, and what waits for something else -----------------------------------------------------


class Clumsy(Task):
    """Needs the gauge, and fails in its first starts."""

    requires = ("load",)
    starts = 0

    def on_start(self):
        Clumsy.starts += 1
        if Clumsy.starts < 5:
            raise RuntimeError("not yet")


def test_a_start_that_is_refused_leaves_the_next_try_as_it_is(fleet, tmp_path):
    Clumsy.starts = 0
    path = tmp_path / "gauge"
    path.touch()
    devices = {"gauge": {"type": Gauge, "settings": {"path": str(path)}}}
    agent = fleet.start("a", tasks={"Clumsy": Clumsy}, devices=devices)
    assert agent.ask(Stop("device")).ok

    reply = agent.ask(Start("Clumsy"))

    assert not reply.ok and "lacks the device types load" in reply.reason
    assert agent.ask(Describe("Clumsy")).result["next_try_s"] is not None
    assert agent.ask(Start("device")).ok
    assert fleet.run_until(lambda: agent.ask(Describe("Clumsy")).result["state"] == "running")


def test_a_task_of_any_service_follows_the_device_that_it_lacked(fleet, tmp_path):
    path = tmp_path / "gauge"
    agent = fleet.start(
        "a",
        services={"plain": Plain},
        tasks={"Reader": {"type": Reader, "service": "plain"}},
        devices={"gauge": {"type": Gauge, "settings": {"path": str(path)}}},
    )
    fleet.run_for(1.0)
    assert agent.ask(Describe("Reader")).result["state"] == "stopped"
    path.touch()
    assert fleet.run_until(lambda: agent.ask(Describe("Reader")).result["state"] == "running")
    assert len([line for line in agent.lines("error") if "Reader" in line]) == 1, "it is told once"


class Tally(Task):
    """Counts."""

    @dataclass
    class State:
        count: int = 0

    @every(hz=10)
    def tick(self, tick):
        """Counts one more."""
        self.state.count += 1


class Slippery(Service):
    """Fails in its constructor as often as it is told."""

    failures = 0

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        if Slippery.failures:
            Slippery.failures -= 1
            raise RuntimeError("not yet")


@pytest.mark.parametrize("keep_state", [True, False])
def test_what_the_tasks_of_a_service_carried_outlives_a_constructor_that_fails(fleet, keep_state):
    tasks = {"Tally": {"type": Tally, "service": "own"}}
    agent = fleet.start("a", services={"own": Slippery}, tasks=tasks)
    fleet.run_for(5.0)
    Slippery.failures = 2
    agent.ask(Restart("own", keep_state=keep_state))
    fleet.run_for(2.0)
    count = agent.ask(Describe("Tally", state=True)).result["state"]["count"]
    assert (count > 50) is keep_state


class Hoarder(Task):
    """Puts into its settings what cannot be saved."""

    @dataclass
    class Settings:
        things: list[int] = field(default_factory=list)

    def on_start(self):
        self.settings.things.append(object())


def test_settings_that_cannot_be_told_end_neither_the_task_nor_its_service(fleet):
    agent = fleet.start("a", tasks={"Hoarder": Hoarder})
    described = agent.ask(Describe("Hoarder"))
    assert described.ok and "cannot be told" in described.result["settings"]["error"]
    assert "cannot be saved" in agent.ask(Configure("Hoarder", {"things": [1]})).reason
    assert agent.ask(Describe("Hoarder")).result["incarnation"] == 1


class Raises(Task):
    """Fails in each tick."""

    @every(hz=10)
    def tick(self, tick):
        """Fails."""
        raise RuntimeError("boom")


def test_a_task_of_the_device_service_that_fails_ends_no_device(fleet, tmp_path):
    path = tmp_path / "gauge"
    path.touch()
    agent = fleet.start(
        "a",
        tasks={"Raises": {"type": Raises, "service": "device"}},
        devices={"gauge": {"type": Gauge, "settings": {"path": str(path)}}},
    )
    fleet.run_for(2.0)
    assert agent.ask(Describe("gauge")).result["incarnation"] == 1
    assert agent.ask(Describe("Raises")).result["failures"] > 1
