"""The planned change of one agent."""

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
    """Return the content of a version's `version.json`."""
    wheels = {wheel.name: wheel.digest for wheel in it.own}
    return {"wheels": wheels, "libraries": it.libraries, "environment": it.environment, "config": digest_of(config)}


def hosted(**others: Any) -> HostedAgent:
    """Return a host's report on an agent."""
    found: Any = {"version": "", "last": "", "config": "", "environment": "", "versions": {}, "about": {}}
    return found | {"service": None, "keys": False, "python": "", "socket": ""} | others


def has(member: Member, it: Supply, service: dict[str, Any] | None = RUNS, **others: Any) -> HostedAgent:
    """Return a host's report on a deployed agent."""
    config = member.path.read_text()
    version, digest = change_of(member, hosted(), it).version, digest_of(config)
    found = {"version": version, "config": digest, "environment": it.environment, "versions": {version: digest}}
    return hosted(**found, about=about(it, config), service=service) | others  # type: ignore[return-value]


@pytest.fixture
def member(tmp_path: Path) -> Member:
    path = tmp_path / "a.toml"
    path.write_text('schema = 1\n[agent]\nname = "a"\n\n[device.load]\ndriver = "host.load"\nrate_hz = 1\n')
    return Member("a", path, (), load(path, (), None), host="robot1")


def test_version_depends_on_environment_and_configuration(member: Member):
    one = change_of(member, hosted(), supply())
    assert one == change_of(member, hosted(), supply()) and one.version.startswith("1.0-") and one.what == "new"
    assert change_of(member, hosted(), supply("f")).version != one.version
    member.path.write_text(member.path.read_text() + "[clock]\nspeed = 2.0\n")
    assert change_of(member, hosted(), supply()).version != one.version


@pytest.mark.parametrize(("service", "what"), [(RUNS, "nothing"), (RESTS, "start"), (None, "start")])
def test_current_version_is_started_or_kept(member: Member, service: dict[str, Any] | None, what: str):
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
def test_changes_are_named(member: Member, after: Supply, changed: tuple[str, ...]):
    found = change_of(member, has(member, supply()), after)
    assert (found.what, found.changed) == ("switch", changed)


def test_changed_configuration_is_named(member: Member):
    before = has(member, supply())
    member.path.write_text(member.path.read_text() + "\n")
    assert change_of(member, before, supply()).changed == ("configuration",)


@pytest.mark.parametrize("edit", [digest_of("rate_hz = 50"), ""])
def test_edit_on_a_host_is_reported_and_replaced(member: Member, edit: str):
    sound = has(member, supply())
    version = sound["version"]
    edited = has(member, supply(), config=edit, versions={version: edit} if edit else {})
    found = change_of(member, edited, supply())
    assert (found.what, found.version, found.was) == ("switch", f"{version}.2", version)
    assert found.changed == ("configuration",) and "its configuration " in found.edited
    # Then the edit is the last version, and the deployed version stays.
    now = has(member, supply(), version=f"{version}.2", versions={version: edit, f"{version}.2": sound["config"]})
    assert change_of(member, now, supply()).what == "nothing"
    # After the edit has been removed, nothing changes either.
    later = has(member, supply(), version=f"{version}.2", versions={f"{version}.2": sound["config"]})
    assert change_of(member, later, supply()).what == "nothing"


def test_deployed_configuration_has_the_fleet_files_changes(member: Member):
    text = effective_config(member.path, ("agent.fleet=yard", "device.load.rate_hz=3"))
    assert tomllib.loads(text) == {
        "schema": 1,
        "agent": {"name": "a", "fleet": "yard"},
        "device": {"load": {"driver": "host.load", "rate_hz": 3}},
    }
    assert effective_config(member.path, ()) == member.path.read_text()


def test_deployed_configuration_has_what_its_file_extends(member: Member):
    (member.path.parent / "common.toml").write_text('schema = 1\n[vars]\nname = "yard"\n[agent]\nfleet = "${name}"\n')
    member.path.write_text('schema = 1\nextends = "common.toml"\n' + member.path.read_text().partition("\n")[2])
    found = tomllib.loads(effective_config(member.path, ()))
    assert found["agent"] == {"name": "a", "fleet": "${name}"} and found["vars"] == {"name": "yard"}
    assert "extends" not in found and found["device"]["load"]["driver"] == "host.load"
