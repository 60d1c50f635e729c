"""What a deployment changes of an agent."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from pancakes.runtime.config import load
from pancakes.tools.deploy.change import AgentChange, change_of, effective_config
from pancakes.tools.launch.member import Member

RUNS = {"state": "active", "pid": 3}


def told(**others: Any) -> dict[str, Any]:
    """What a host says of an agent."""
    return {"version": "", "last": "", "service": None, **others}


@pytest.fixture
def member(tmp_path: Path) -> Member:
    path = tmp_path / "a.toml"
    path.write_text('schema = 1\n[agent]\nname = "a"\n\n[device.load]\ndriver = "host.load"\n')
    return Member("a", path, (), load(path, (), None), host="robot1")


def change(member: Member, build: str = "1.0-aa", environment: str = "e", **others: Any) -> AgentChange:
    return change_of(member, told(**others), build, environment)


def test_a_version_is_its_environment_and_its_configuration(member: Member):
    one = change(member)
    assert one == change(member) and one.version.startswith("1.0-")
    assert change(member, environment="f").version != one.version
    member.path.write_text(member.path.read_text() + "rate_hz = 2.0\n")
    assert change(member).version != one.version


@pytest.mark.parametrize(
    ("was", "service", "what"),
    [
        ("", None, "new"),
        ("old", RUNS, "switch"),
        ("old", {"state": "inactive", "pid": 0}, "switch"),
        ("this", RUNS, "nothing"),
        ("this", {"state": "failed", "pid": 0}, "start"),
    ],
)
def test_what_is_done_follows_from_what_is_there(member: Member, was: str, service: dict[str, Any] | None, what: str):
    version = change(member).version if was == "this" else was
    assert change(member, version=version, service=service).what == what


def test_what_a_fleet_file_sets_is_in_the_configuration_that_is_brought(member: Member):
    text = effective_config(member.path, ("agent.fleet=yard", "device.load.rate_hz=3"))
    assert tomllib.loads(text) == {
        "schema": 1,
        "agent": {"name": "a", "fleet": "yard"},
        "device": {"load": {"driver": "host.load", "rate_hz": 3}},
    }
    assert effective_config(member.path, ()) == member.path.read_text()
