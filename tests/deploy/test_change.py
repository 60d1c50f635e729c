"""What a deployment changes of an agent."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from pancakes.config import load
from pancakes.tools.deploy.plan import Supply, change_of, digest_of, effective_config
from pancakes.tools.deploy.wheels import Wheel
from pancakes.tools.launch.fleet_file import Member
from pancakes.tools.launch.remote_hosts import HostedAgent

RUNS = {"manager": "systemd", "state": "active", "pid": 3, "restarts": 0}
RESTS = {**RUNS, "state": "inactive", "pid": 0}


def wheel(name: str, digest: str) -> Wheel:
    return Wheel(Path(name), digest, 1)


def supply(environment: str = "e", yard: str = "1.0", **others: Any) -> Supply:
    own = [wheel("pancakes_agents-1.0-py3.whl", "aa"), wheel(f"yard-{yard}-py3.whl", others.pop("seal", "bb"))]
    host: Any = None
    return Supply(host, "1.0-aa", environment, own, others.pop("libraries", "l"), [], [])


def about(it: Supply, config: str) -> dict[str, Any]:
    """What is written beside a version."""
    wheels = {wheel.name: wheel.digest for wheel in it.own}
    return {"wheels": wheels, "libraries": it.libraries, "environment": it.environment, "config": digest_of(config)}


def told(**others: Any) -> HostedAgent:
    """What a host says of an agent."""
    found: Any = {"version": "", "last": "", "config": "", "environment": "", "versions": {}, "about": {}}
    return found | {"service": None, "keys": False, "python": "", "socket": ""} | others


def has(member: Member, it: Supply, service: dict[str, Any] | None = RUNS, **others: Any) -> HostedAgent:
    """What a host says of an agent that was brought there."""
    config = member.path.read_text()
    version, digest = change_of(member, told(), it).version, digest_of(config)
    found = {"version": version, "config": digest, "environment": it.environment, "versions": {version: digest}}
    return told(**found, about=about(it, config), service=service) | others  # type: ignore[return-value]


@pytest.fixture
def member(tmp_path: Path) -> Member:
    path = tmp_path / "a.toml"
    path.write_text('schema = 1\n[agent]\nname = "a"\n\n[device.load]\ndriver = "host.load"\nrate_hz = 1\n')
    return Member("a", path, (), load(path, (), None), host="robot1")


def test_a_version_is_its_environment_and_its_configuration(member: Member):
    one = change_of(member, told(), supply())
    assert one == change_of(member, told(), supply()) and one.version.startswith("1.0-") and one.what == "new"
    assert change_of(member, told(), supply("f")).version != one.version
    member.path.write_text(member.path.read_text() + "[clock]\nspeed = 2.0\n")
    assert change_of(member, told(), supply()).version != one.version


@pytest.mark.parametrize(("service", "what"), [(RUNS, "nothing"), (RESTS, "start"), (None, "start")])
def test_what_is_there_is_started_or_left_alone(member: Member, service: dict[str, Any] | None, what: str):
    found = change_of(member, has(member, supply(), service), supply())
    assert (found.what, found.changed, found.edited) == (what, (), "")


@pytest.mark.parametrize(
    ("after", "changed"),
    [
        (supply("f", yard="2.0"), ("yard 1.0 → 2.0", "environment")),
        (supply("f", seal="cc"), ("yard 1.0 is another build", "environment")),
        (supply("f", libraries="m"), ("libraries", "environment")),
    ],
)
def test_what_has_changed_is_named(member: Member, after: Supply, changed: tuple[str, ...]):
    found = change_of(member, has(member, supply()), after)
    assert (found.what, found.changed) == ("switch", changed)


def test_a_configuration_that_has_changed_is_named(member: Member):
    before = has(member, supply())
    member.path.write_text(member.path.read_text() + "\n")
    assert change_of(member, before, supply()).changed == ("configuration",)


@pytest.mark.parametrize("edit", [digest_of("rate_hz = 50"), ""])
def test_what_was_edited_on_a_host_is_told_and_made_again(member: Member, edit: str):
    sound = has(member, supply())
    version = sound["version"]
    edited = has(member, supply(), config=edit, versions={version: edit} if edit else {})
    found = change_of(member, edited, supply())
    assert (found.what, found.version, found.was) == ("switch", f"{version}.2", version)
    assert found.changed == ("configuration",) and "its configuration " in found.edited
    # The edit is the last version then, and what was deployed stays.
    now = has(member, supply(), version=f"{version}.2", versions={version: edit, f"{version}.2": sound["config"]})
    assert change_of(member, now, supply()).what == "nothing"
    # Once the edit is cleaned away, nothing changes either.
    later = has(member, supply(), version=f"{version}.2", versions={f"{version}.2": sound["config"]})
    assert change_of(member, later, supply()).what == "nothing"


def test_what_a_fleet_file_sets_is_in_the_configuration_that_is_brought(member: Member):
    text = effective_config(member.path, ("agent.fleet=yard", "device.load.rate_hz=3"))
    assert tomllib.loads(text) == {
        "schema": 1,
        "agent": {"name": "a", "fleet": "yard"},
        "device": {"load": {"driver": "host.load", "rate_hz": 3}},
    }
    assert effective_config(member.path, ()) == member.path.read_text()
