"""The JSON Schema of a configuration and what a configuration comes to: both follow from the types that read it."""

from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from seeded import for_each

from pancakes.config import AgentConfig, DeviceConfig, TaskConfig, load, parse, read_task
from pancakes.config.effective import created_tables, effective, origin, table_of
from pancakes.config.schema import config_schema
from pancakes.config.toml_writer import document_text
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Wanted
from pancakes.durable.snapshot import Snapshot
from pancakes.errors import ConfigError
from pancakes.migration import GuardRule, MigrationRule
from pancakes.task import Task
from pancakes.util.plugins import Plugins

ROOT = Path(__file__).resolve().parents[2]
FILES = [it for it in sorted((ROOT / "configs").glob("*/*.toml")) if it.stem not in ("common", "fleet", "robot")] + [
    ROOT / "configs" / "single.toml"
]


class Walk(Task):
    @dataclass
    class Settings:
        speed_mps: float = 0.1
        name: str = "walker"

    settings: Settings


PLUGINS = Plugins({("pancakes.tasks", "test.Walk"): Walk})


def test_the_schema_has_every_key() -> None:
    schema = config_schema()
    properties = schema["properties"]

    tables = ["agent", "access", "clock", "record", "channel", "device", "filter", "service", "task"]
    assert list(properties) == ["schema", "extends", "vars", *tables]
    assert set(properties["agent"]["properties"]) == set(AgentConfig.__struct_fields__)
    for table, cls in (("device", DeviceConfig), ("task", TaskConfig)):
        entry = properties[table]["additionalProperties"]
        assert set(entry["properties"]) == set(cls.__struct_fields__) - {"name"}
        assert entry["additionalProperties"] is False
    required = schema["then"]["properties"]
    assert required["device"]["additionalProperties"]["required"] == ["driver"]
    assert "service" not in required and required["agent"]["required"] == ["name"]


def test_each_key_is_explained() -> None:
    for table in ("agent", "access", "clock"):
        for key, part in config_schema()["properties"][table]["properties"].items():
            assert part.get("description"), f"[{table}] {key}"


def test_all_references_lead_somewhere() -> None:
    schema = config_schema()

    def references(part: Any) -> list[str]:
        if isinstance(part, list):
            return [found for item in part for found in references(item)]
        if not isinstance(part, dict):
            return []
        own = [part["$ref"]] if "$ref" in part else []
        return own + [found for item in part.values() for found in references(item)]

    found = references(schema)
    assert found
    assert {name.removeprefix("#/$defs/") for name in found} <= set(schema["$defs"])


def test_with_plugins_the_settings_of_each_are_described() -> None:
    entry = config_schema(PLUGINS)["properties"]["task"]["additionalProperties"]

    assert "test.Walk" in entry["properties"]["type"]["enum"]
    rule = next(rule for rule in entry["allOf"] if rule["if"]["properties"]["type"] == {"const": "test.Walk"})
    settings = rule["then"]["properties"]["settings"]
    assert settings["properties"]["speed_mps"]["default"] == 0.1
    assert settings["additionalProperties"] is False


TEXT = """
schema = 1
[agent]
name = "a"
[task.Walk]
type = "test.Walk"
settings = { speed_mps = 0.5 }
[device.load]
driver = "host.load"
rate_hz = 1
"""


def test_a_configuration_is_shown_with_its_defaults_and_where_each_was_said() -> None:
    config = parse(TEXT, "a.toml", ("clock={ speed = 5 }", "task.Walk.rate_hz=2"), PLUGINS)
    tables = effective(config, PLUGINS)

    assert tables["task"]["Walk"]["settings"] == {"speed_mps": 0.5, "name": "walker"}
    assert "hold_after_mission_s" not in tables["device"]["load"]  # which is for actuators
    expected = {
        ("schema",): "a.toml:2",
        ("agent", "name"): "a.toml:4",
        ("agent", "fleet"): "default",
        ("clock", "speed"): "--set clock={ speed = 5 }",
        ("clock", "hold"): "default",
        ("task", "Walk", "settings", "speed_mps"): "a.toml:7",
        ("task", "Walk", "settings", "name"): "default",
        ("task", "Walk", "rate_hz"): "--set task.Walk.rate_hz=2",
    }
    assert {keys: origin(config, keys) for keys in expected} == expected


def test_effective_config_means_the_same_when_read():
    plugins = Plugins()

    def check(path):
        shown = effective(load(path, plugins=plugins), plugins)

        again = parse(document_text(shown), "shown", plugins=plugins)

        assert effective(again, plugins) == shown

    for_each(FILES, check)


def test_rules_recordings_and_created_tasks_are_shown_as_a_configuration_too() -> None:
    rules = '[access]\nrefuse = ["end"]\n[[access.allow]]\nwho = ["b"]\nmay = ["look"]\n'
    config = parse(f'{TEXT}\n{rules}\n[record]\npath = "x.mcap"\n', "a.toml", plugins=PLUGINS)
    a, rule = Identity("a"), {"when": "battery", "below": 0.2, "above": None, "field": "level", "cost": "tasks"}
    snapshot = Snapshot(
        TaskId("a", "Other"),
        "test.Walk",
        "1",
        "client",
        settings={"speed_mps": 0.25, "name": "other"},
        periods_s={"walk": 0.2},
        restart={"policy": "no"},
        migrate={**rule, "then": "Walk"},
        guard={"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5, "guardians": ["b"], "takeover": "ask"},
    ).encode()
    owned = Register(Epoch(1, a), 0, ((a,),), state=snapshot, promised=Epoch(1, a))
    here = Record(TaskId("a", "Other"), owned._replace(wanted=Wanted.STOPPED), a)
    others = [
        Record(TaskId("b", "Guest"), owned, a),
        Record(TaskId("a", "Away"), Register(Epoch(2, Identity("b")), -1, promised=Epoch(2, Identity("b"))), a),
        Record(TaskId("a", "Broken"), owned._replace(state=b"?"), a),
    ]
    created = created_tables("a", [*others, here])
    assert list(created) == ["Other"]

    found = effective(config, PLUGINS)
    tables = {**found, "task": {**found["task"], **created}}
    again = parse(document_text(tables), "kept", plugins=PLUGINS)

    assert again.access == config.access and again.record == config.record
    other = again.tasks["Other"]
    assert (other.rate_hz, other.start, dict(other.settings)) == (5.0, False, {"speed_mps": 0.25, "name": "other"})
    assert other.migrate == MigrationRule("battery", 0.2, then="Walk") and other.restart.policy == "no"
    assert other.guard == GuardRule(3, 2.0, 0.5, ("b",), "ask")


def test_a_task_that_rests_is_shown_with_the_rate_0() -> None:
    rests = Snapshot(TaskId("a", "Other"), "test.Walk", "1", "client", periods_s={"walk": inf})
    assert table_of(rests, start=True)["rate_hz"] == 0
    assert table_of(replace(rests, rate_hz=2.0), start=True)["rate_hz"] == 0


@pytest.mark.parametrize(
    ("table", "faults"),
    [
        ({"type": "test.Walk"}, []),
        ({}, ["[task.New] type: is missing"]),
        ({"type": "test.Wakl", "rate_hz": -1}, ["[task.New] rate_hz: ", "[task.New] type: unknown task type"]),
        ({"type": "test.Walk", "service": "clint"}, ["[task.New] service: there is no service 'clint'"]),
        ({"type": "test.Walk", "migrate": {"when": "battery"}}, ["[task.New] migrate: needs a bound"]),
        ({"type": "test.Walk", "settings": {"sped": 1}}, ["[task.New] settings.sped: unknown key"]),
    ],
)
def test_the_table_of_a_task_beside_a_file_is_checked_as_if_that_had_it(
    table: dict[str, object], faults: list[str]
) -> None:
    config = parse(TEXT, "a.toml", plugins=PLUGINS)
    if not faults:
        assert read_task("New", table, config, PLUGINS).settings == {}
        return
    with pytest.raises(ConfigError) as caught:
        read_task("New", table, config, PLUGINS)
    assert len(caught.value.faults) == len(faults)
    for fault, start in zip(caught.value.faults, faults, strict=True):
        assert str(fault).startswith(f"New: {start}"), str(fault)
