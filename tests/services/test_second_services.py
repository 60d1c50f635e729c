"""A second instance of a core service under another name: what a service is given goes by its class."""

import urllib.request
from dataclasses import dataclass
from pathlib import Path

from pancakes.control import Describe, Migrate, Start, Stop
from pancakes.devices import Load, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.kernel.handlers import on
from pancakes.task import Task, every
from pancakes.testing import Fleet, no_thread_left, threaded_agent
from pancakes.tools.metrics.metrics_service import MetricsService


class Gauge(Sensor):
    """Always reads the same."""

    type = "load"

    def read(self):
        return Load(0.25)


class Wheels(Actuator):
    """Says on `log` what it does."""

    type = "motors"

    def write(self, command, valid_s, source):
        pass

    def safe_stop(self):
        self.context.log("info", "stands")


class Drive(Task):
    """Needs devices of two services, and counts what it reads."""

    requires = ("load", "motors")

    @dataclass
    class State:
        read: int = 0

    @on("system", Load)
    def load(self, packet):
        self.state.read += 1

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))


class Note(Task):
    """A task of the configuration in a device service."""


SENSORS = {"sensors": {"type": "device"}}
DEVICES = {
    "gauge": {"type": Gauge, "service": "sensors", "rate_hz": 10.0},
    "wheels": {"type": Wheels, "service": "sensors"},
    "other": {"type": Gauge},
}


def states(agent):
    return {service["service"]: service["state"] for service in agent.ask(Describe()).result["services"]}


def test_a_device_service_without_devices_runs():
    with Fleet() as fleet:
        agent = fleet.start("a", '[service.sensors]\ntype = "device"\n')
        assert states(agent) == dict.fromkeys(["log", "device", "sensors", "network", "client"], "running")


def test_a_second_device_service_has_the_devices_that_name_it():
    with Fleet() as fleet:
        agent = fleet.start("a", services=SENSORS, devices=DEVICES, tasks={"Drive": Drive})
        assert agent.running("sensors") == ["gauge", "wheels"]
        assert agent.running("device") == ["other"]
        assert agent.running() == ["Drive"]
        fleet.run_for(1.0)
        assert agent.task("Drive").state.read >= 9
        assert agent.wait_for(Load).source == "a/sensors/gauge"
        told = agent.ask(Describe("sensors/gauge")).result
        assert (told["device"], told["service"]) == ("load", "sensors")


def test_its_actuators_stand_when_their_holder_lets_go_and_obey_nobody_else():
    with Fleet() as fleet:
        agent = fleet.start("a", services=SENSORS, devices=DEVICES, tasks={"Drive": Drive})
        fleet.run_for(0.5)
        assert agent.ask(Describe("sensors/wheels")).result["holder"] == "a/client/Drive"
        assert agent.ask(Stop("Drive")).ok
        assert agent.wait_for_event("safe_hold", device="wheels")["reason"] == "Drive let go of it"
        agent.publish("ctrl", Twist(1.0, 0.0))
        agent.wait_for_event("command_refused", device="wheels")


def test_a_device_service_looks_after_tasks_of_the_configuration_too():
    with Fleet() as fleet:
        agent = fleet.start("a", services=SENSORS, tasks={"Note": {"type": Note, "service": "sensors"}})
        assert agent.ask(Describe("sensors/Note")).result["state"] == "running"
        assert states(agent)["sensors"] == "running"


def test_a_second_client_service_keeps_its_tasks_over_a_crash():
    with Fleet() as fleet:
        tasks = {"Drive": {"type": Drive, "service": "crew"}}
        agent = fleet.start("a", services={"crew": "client", **SENSORS}, devices=DEVICES, tasks=tasks)
        fleet.run_for(3.0)
        read = agent.task("Drive", "crew").state.read
        fleet.crash("a")
        agent = fleet.restart("a")
        assert agent.task("Drive", "crew").state.read >= read - 15
        assert agent.running("client") == []


def test_a_second_log_service_has_a_file_and_a_recorder_of_its_own(tmp_path: Path):
    services = {
        "log": {"settings": {"console": False}},
        "audit": {"type": "log", "settings": {"console": False, "file": str(tmp_path / "audit.jsonl")}},
    }
    record = f'[record]\npath = "{tmp_path}/first.mcap"\n'
    with no_thread_left(), threaded_agent("a", record, services=services, tasks={"Note": Note}) as agent:
        assert agent.running("log") == ["Recorder"]
        assert agent.running("audit") == ["File"]
        path = str(tmp_path / "second.mcap")
        assert agent.ask(Start("audit/Recorder", {"path": path})).ok
        assert agent.running("audit") == ["File", "Recorder"]
        assert agent.ask(Stop("Recorder")).reason == "a has 'Recorder' in log and in audit: say which"
        assert agent.ask(Stop("audit/Recorder")).ok
        assert agent.running("log") == ["Recorder"]
    assert (tmp_path / "first.mcap").exists() and (tmp_path / "second.mcap").exists()
    assert "task_started" in (tmp_path / "audit.jsonl").read_text()


def test_a_recording_that_a_second_log_service_was_asked_for_goes_on_when_its_agent_comes_back(tmp_path: Path):
    services = {"audit": {"type": "log", "settings": {"console": False}}}
    with Fleet() as fleet:
        agent = fleet.start("a", services=services)
        assert agent.ask(Start("audit/Recorder", {"path": str(tmp_path / "audit.mcap")})).ok
        fleet.stop("a")
        agent = fleet.restart("a")
        assert (agent.running("log"), agent.running("audit")) == ([], ["Recorder"])
        assert agent.ask(Stop("audit/Recorder")).ok


def test_a_second_metrics_service_serves_at_a_port_of_its_own():
    metrics = {"type": "metrics", "settings": {"port": 0}}
    with no_thread_left(), threaded_agent("a", services={"metrics": metrics, "more": metrics}) as agent:
        services = [agent.component(name).facade for name in ("metrics", "more")]
        ports = [service.port for service in services if isinstance(service, MetricsService)]
        assert len(set(ports)) == 2
        for port in ports:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
                assert b"pancakes_" in answer.read()


def test_a_second_network_service_of_a_configuration_made_in_code_is_left_out_with_a_sentence():
    with Fleet() as fleet:
        agent = fleet.start("a", services={"radio": "network"}, tasks={"Note": Note})
        fleet.start("b")
        fleet.connect()
        assert "radio" not in states(agent)
        reason = "the service radio does not run: an agent has one NetworkService, and that is network"
        assert reason in agent.lines("error")
        assert agent.ask(Migrate("Note", dry_run=True)).result["winner"] == "b"


def test_a_device_whose_service_is_none_for_devices_is_named():
    with Fleet() as fleet:
        agent = fleet.start("a", devices={"gauge": {"type": Gauge, "service": "client"}})
        reason = "the device gauge does not run: no device service 'client' does"
        assert reason in agent.lines("error")
