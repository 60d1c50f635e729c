"""A configuration names plug-ins: they must exist, their settings must fit, and what tasks need must be there."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
from msgspec import Meta

from pancakes.config import load, parse
from pancakes.config.checks import doubts_of
from pancakes.devices import Battery, Pose
from pancakes.devices.driver import Actuator, Sensor
from pancakes.durable.client_service import ClientService
from pancakes.errors import ConfigError
from pancakes.mesh.tcp import TcpTransport
from pancakes.service import Service
from pancakes.services.device import DeviceService
from pancakes.services.network import NetworkService
from pancakes.task import Task
from pancakes.util.plugins import Plugins


class Compass(Sensor):
    type = "pose"
    rate = "optional"

    @dataclass
    class Settings:
        offset_rad: float = 0.0

    def read(self) -> Pose:
        return Pose(0.0, 0.0, self.settings.offset_rad)


class Wheels(Actuator):
    type = "motors"

    def write(self, command: Any, ttl_s: float, source: str) -> None: ...

    def safe_stop(self) -> None: ...


class Beacon(Sensor):
    type = "pose"
    rate = "none"

    @dataclass
    class Settings:
        max_hz: float | None = None

    def read(self) -> None: ...


class Gauge(Sensor):
    type = "gauge"

    def read(self) -> None: ...


class Pump(Wheels):
    type = "pump"

    def tick(self) -> None: ...


class Untyped(Sensor):
    rate = "optional"

    def read(self) -> None: ...


class Circle(Task):
    requires = ("pose", "motors")

    @dataclass
    class Settings:
        radius_m: Annotated[float, Meta(gt=0)] = 0.5


class Watch(Task):
    pass


PARTS = {
    **{("pancakes.services", name): Service for name in ("log", "client")},
    ("pancakes.services", "device"): DeviceService,
    ("pancakes.services", "network"): NetworkService,
    ("pancakes.transports", "tcp"): TcpTransport,
    ("pancakes.drivers", "test.compass"): Compass,
    ("pancakes.drivers", "test.wheels"): Wheels,
    ("pancakes.drivers", "test.beacon"): Beacon,
    ("pancakes.drivers", "test.gauge"): Gauge,
    ("pancakes.drivers", "test.pump"): Pump,
    ("pancakes.drivers", "test.untyped"): Untyped,
    ("pancakes.drivers", "test.function"): len,
    ("pancakes.tasks", "test.Circle"): Circle,
    ("pancakes.tasks", "test.Watch"): Watch,
    ("pancakes.tasks", "test.Service"): Service,
    ("pancakes.costs", "tasks"): len,
    ("pancakes.packets", "devices"): Battery,
}

HEAD = 'schema = 1\n[agent]\nname = "agent1"\n'
DEVICES = '[device.wheels]\ndriver = "test.wheels"\n[device.compass]\ndriver = "test.compass"\n'


def faults(text: str, parts: dict[tuple[str, str], Any] | None = None) -> list[str]:
    """The faults of a text that begins on line 4."""
    try:
        parse(HEAD + text, "a.toml", [], Plugins(extra=parts or PARTS))
    except ConfigError as error:
        return [str(fault) for fault in error.faults]
    return []


def test_a_sound_configuration():
    text = 'listen = "tcp://127.0.0.1:0"\n' + DEVICES + '[task.Circle]\ntype = "test.Circle"\nsettings.radius_m = 1\n'
    assert faults(text) == []


def test_names_that_nobody_offers():
    text = '[device.d]\ndriver = "test.compas"\n[service.s]\ntype = "lidar.M"\n[task.Circle]\ntype = "Circle"\n'
    assert faults(text) == [
        "a.toml:5: [device.d] driver: unknown driver 'test.compas', did you mean 'test.compass'?",
        "a.toml:7: [service.s] type: unknown service type 'lidar.M': no installed distribution provides services"
        " under 'lidar.'",
        "a.toml:9: [task.Circle] type: unknown task type 'Circle', did you mean 'test.Circle'?",
    ]


def test_an_address_of_a_transport_that_nobody_offers():
    assert faults('listen = "tpc://127.0.0.1:1"\npeers = ["udp://127.0.0.1:1"]\n') == [
        "a.toml:4: [agent] listen: unknown transport 'tpc' in 'tpc://127.0.0.1:1', did you mean 'tcp'?",
        "a.toml:5: [agent] peers[0]: unknown transport 'udp' in 'udp://127.0.0.1:1'",
    ]


def test_the_settings_of_the_transport_are_checked_against_its_class():
    text = 'listen = "tcp://127.0.0.1:1"\n[service.network]\nsettings.transports.tcp = { dial_s = 0, dials_s = 1 }\n'
    assert faults(text) == [
        "a.toml:6: [service.network] settings.transports.tcp.dial_s: expected a number > 0, not 0",
        "a.toml:6: [service.network] settings.transports.tcp.dials_s: unknown key",
    ]


def test_settings_are_checked_against_the_class():
    text = (
        DEVICES
        + """settings = { offset = 1 }
[service.log]
settings = { colour = true }
[task.Circle]
type = "test.Circle"
start = false
[task.Circle.settings]
radius_m = -1
"""
    )
    assert faults(text) == [
        "a.toml:8: [device.compass] settings.offset: unknown key, did you mean 'offset_rad'?",
        "a.toml:10: [service.log] settings.colour: unknown key",
        "a.toml:15: [task.Circle] settings.radius_m: expected a number > 0, not -1",
    ]


def test_a_channel_of_the_client_service_has_a_name():
    text = '[service.client]\nsettings = { channels = ["map", "a/b"] }\n'
    (said,) = faults(text, {**PARTS, ("pancakes.services", "client"): ClientService})
    assert said.startswith("a.toml:5: [service.client] settings: channels: 'a/b' is not a name: a name has letters")


def test_a_second_network_service_is_refused_and_second_ones_of_the_others_are_not():
    second = "".join(f'[service.{name}2]\ntype = "{name}"\n' for name in ("device", "log", "client", "network"))
    assert faults(second) == [
        "a.toml:11: [service.network2] type: an agent has one service of the type 'network', and that is"
        " [service.network]"
    ]


def test_the_service_of_a_device_must_be_there_and_be_one_for_devices():
    text = (
        '[service.sensors]\ntype = "device"\n'
        '[device.compass]\ndriver = "test.compass"\nservice = "sensors"\n'
        '[device.other]\ndriver = "test.compass"\nservice = "sensor"\n'
        '[device.wheels]\ndriver = "test.wheels"\nservice = "client"\n'
    )
    assert faults(text) == [
        "a.toml:11: [device.other] service: there is no service 'sensor', did you mean 'sensors'?",
        "a.toml:14: [device.wheels] service: 'client' is not a service for devices",
    ]


@pytest.mark.parametrize(
    ("driver", "rate", "refused"),
    [
        ("gauge", None, "is missing: 'test.gauge' has a reading only at a rate, such as `rate_hz = 1`"),
        ("gauge", 0, ""),
        ("gauge", 5, ""),
        ("beacon", None, ""),
        (
            "beacon",
            5,
            "is not for 'test.beacon', whose readings come when its hardware has them: `settings.max_hz` bounds them",
        ),
        ("compass", None, ""),
        ("compass", 5, ""),
        ("wheels", None, ""),
        ("wheels", 5, "is not for 'test.wheels', which does nothing at a rate"),
        ("pump", 5, ""),
    ],
)
def test_a_rate_that_a_driver_needs_or_does_not_take(driver, rate, refused):
    text = f'[device.d]\ndriver = "test.{driver}"\n' + (f"rate_hz = {rate}\n" if rate is not None else "")
    line = 4 if rate is None else 6
    assert faults(text) == ([f"a.toml:{line}: [device.d] rate_hz: {refused}"] if refused else [])


def test_a_task_may_bear_the_name_of_a_device_of_another_service():
    text = (
        '[service.sensors]\ntype = "device"\n'
        '[device.compass]\ndriver = "test.compass"\nservice = "{}"\n'
        '[task.compass]\ntype = "test.Watch"\nservice = "sensors"\n'
    )
    assert faults(text.format("device")) == []
    assert faults(text.format("sensors")) == [
        "a.toml:9: [task.compass]: has the same address as [device.compass]: give one of them another name"
    ]


def test_what_is_wrong_with_the_format_and_with_the_plugins_comes_together(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(HEAD + '[clock]\nspeed = 0\n[task.Circle]\ntype = "test.Cirlce"\nstrat = true\n')

    with pytest.raises(ConfigError) as error:
        load(path, ["task.Circle.migrate={ when = 'batery', below = 0.5, cost = 'taks' }"], Plugins(extra=PARTS))
    assert [(fault.where.rpartition("/")[2][:10], fault.suggestion) for fault in error.value.faults] == [
        ("a.toml:5", ""),
        ("a.toml:7", "test.Circle"),
        ("a.toml:8", "start"),
        ("--set task", "tasks"),
        ("--set task", "battery"),
    ]


class TestRequires:
    def test_a_device_that_is_not_there(self):
        text = '[device.compass]\ndriver = "test.compass"\n[task.Circle]\ntype = "test.Circle"\n'
        assert faults(text) == [
            "a.toml:7: [task.Circle] type: needs a device of the type motors; this agent has pose",
        ]

    def test_no_device_at_all(self):
        assert faults('[task.Circle]\ntype = "test.Circle"\n') == [
            "a.toml:5: [task.Circle] type: needs devices: pose, motors; this agent has no device",
        ]

    def test_a_task_that_is_not_started_may_wait_for_its_device(self):
        assert faults('[task.Circle]\ntype = "test.Circle"\nstart = false\n') == []

    def test_a_task_that_a_migration_will_start_may_not(self):
        text = """[task.Circle]
type = "test.Circle"
start = false
[task.Watch]
type = "test.Watch"
migrate = { when = "battery", below = 0.5, then = "Circle" }
"""
        (fault,) = faults(text)
        assert fault.startswith("a.toml:5: [task.Circle] type: needs devices")


class TestMigrationRules:
    def rule(self, rule: str) -> list[str]:
        return faults(f'[task.Watch]\ntype = "test.Watch"\nmigrate = {rule}\n')

    def test_the_cost_is_a_plugin(self):
        assert self.rule('{ when = "battery", below = 0.5, cost = "task" }') == [
            "a.toml:6: [task.Watch] migrate.cost: unknown cost 'task', did you mean 'tasks'?"
        ]

    def test_so_is_each_that_has_a_weight(self):
        assert self.rule('{ when = "battery", below = 0.5, cost = { tasks = 1, task = 2.5 } }') == [
            "a.toml:6: [task.Watch] migrate.cost.task: unknown cost 'task', did you mean 'tasks'?"
        ]

    def test_the_packets_it_watches_are_of_a_known_type(self):
        assert self.rule('{ when = "batterie", below = 0.5 }') == [
            "a.toml:6: [task.Watch] migrate.when: unknown type of packets 'batterie', did you mean 'battery'?"
        ]

    def test_the_field_is_one_of_theirs(self):
        assert self.rule('{ when = "battery", below = 7, field = "voltage" }') == [
            (
                "a.toml:6: [task.Watch] migrate.field: a packet of the type 'battery' has no field 'voltage',"
                " but voltage_v, level, charging, did you mean 'voltage_v'?"
            )
        ]
        (fault,) = self.rule('{ when = "pose", below = 0.5 }')
        assert "a packet of the type 'pose' has no field 'level', but x_m, y_m, theta_rad" in fault

    def test_a_rule_on_the_reserve_has_a_bound_in_seconds(self):
        assert self.rule('{ when = "reserve", below = 30, cost = "reserve" }') == []

    def test_a_rule_on_a_reserve_that_nothing_tells_is_doubted(self):
        text = '[task.Watch]\ntype = "test.Watch"\nmigrate = { when = "reserve", below = 30 }\n'
        (doubt,) = doubts_of(parse(HEAD + text, "a.toml"))
        assert "no task of the type 'energy.reserve' is here" in str(doubt) and str(doubt).startswith("a.toml:6: ")
        told = '[task.Reserve]\ntype = "energy.reserve"\nsettings = { level_per_m = 0.01 }\n'
        assert doubts_of(parse(HEAD + text + told, "a.toml")) == []


class TestDevices:
    def test_only_an_actuator_has_a_hold(self):
        text = DEVICES + "hold_after_mission_s = 1\n"
        assert faults(text) == [
            "a.toml:8: [device.compass] hold_after_mission_s: is for actuators, and 'test.compass' is not one",
        ]

    def test_a_plugin_of_the_wrong_kind_is_its_authors_mistake(self):
        text = '[device.a]\ndriver = "test.untyped"\n[device.b]\ndriver = "test.function"\n'
        assert faults(text + '[task.t]\ntype = "test.Service"\n') == [
            (
                "a.toml:5: [device.a] driver: 'test.untyped' does not define the type of its device:"
                " a defect of its distribution"
            ),
            (
                "a.toml:7: [device.b] driver: 'test.function' is not a driver but builtin_function_or_method len:"
                " a defect of its distribution"
            ),
            (
                "a.toml:9: [task.t] type: 'test.Service' is not a task but the class Service:"
                " a defect of its distribution"
            ),
        ]


class TestPluginsThatFailToImport:
    """They are no fault of the file: the agent runs without them, and `Plugins.problems` says what to log."""

    @pytest.fixture
    def plugins(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plugins:
        information = tmp_path / "broken_parts-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-parts\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(
            "[pancakes.tasks]\nbroken.Task = broken_parts:Task\n"
            "[pancakes.drivers]\nbroken.driver = broken_parts:Driver\n"
            "[pancakes.packets]\nbroken = broken_parts\n"
        )
        (tmp_path / "broken_parts.py").write_text("raise RuntimeError('no camera')\n")
        monkeypatch.syspath_prepend(tmp_path)
        return Plugins(extra=PARTS)

    def test_the_configuration_is_sound(self, plugins: Plugins):
        config = parse(HEAD + '[task.X]\ntype = "broken.Task"\n', "a.toml", [], plugins)

        assert config.tasks["X"].type == "broken.Task"
        assert "'broken.Task' of broken-parts 1.0 (broken_parts:Task) cannot be loaded" in str(plugins.problems()[0])

    def test_a_device_of_unknown_type_may_be_what_a_task_needs(self, plugins: Plugins):
        text = '[device.d]\ndriver = "broken.driver"\n[task.Circle]\ntype = "test.Circle"\n'
        assert parse(HEAD + text, "a.toml", [], plugins)

    def test_a_module_of_packets_may_have_had_the_type_that_a_rule_watches(self, plugins: Plugins):
        text = '[task.Watch]\ntype = "test.Watch"\nmigrate = { when = "smell", field = "strength", below = 1 }\n'
        assert parse(HEAD + text, "a.toml", [], plugins)
