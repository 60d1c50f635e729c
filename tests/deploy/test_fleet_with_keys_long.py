"""Three bare hosts become a fleet with keys by one command; then a person's week with them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from cli.processes import Rig
from deploy.deploying import deploy
from deploy.plugin_wheels import plugin_wheel
from deploy.ssh_hosts import BARE, SshHosts, free_port, with_sshd

pytestmark = [with_sshd, pytest.mark.timeout(900)]
AGAIN_S = 20.0  # 5 s on a machine that does nothing else
WALK = '[task.Walk]\ntype = "yard.Walk"\nsettings = { broken = false }\nrestart = { policy = "no" }\n'


class Yard:
    """A fleet of three agents with keys over TCP, each on its host, and the operator's machine."""

    def __init__(self, rig: Rig, hosts: SshHosts, core: Path) -> None:
        self.rig, self.hosts = rig, hosts
        self.ports = {name: free_port() for name in "abc"}
        text = 'schema = 1\n[fleet]\nname = "yard"\n'
        for index, (name, port) in enumerate(self.ports.items()):
            hosts.add(f"robot{index + 1}", BARE)
            dials = f'peers = ["tcp://127.0.0.1:{self.ports["a"]}"]\n' if index else ""
            own = f'schema = 1\n[agent]\nname = "{name}"\nlisten = "tcp://127.0.0.1:{port}"\n{dials}'
            (rig.directory / f"{name}.toml").write_text(own + ("" if index else WALK))
            text += f'[agent.{name}]\nhost = "robot{index + 1}"\n'
        self.file = rig.directory / "yard.toml"
        self.file.write_text(text)
        self.first = plugin_wheel(rig.directory / "1", "1.0")
        self._core = core

    def deploy(self, *more: str | Path, wheel: Path | None = None) -> tuple[int, str]:
        words = (self.file, "--wheels", self._core, "--wheels", wheel or self.first, "--calm", "1s", *more)
        done = deploy(self.rig, *words)
        return done.returncode, done.stderr

    def asked(self, *words: str) -> Any:
        at = ("--at", f"127.0.0.1:{self.ports['a']}", "--fleet", "yard", "--format", "json")
        done = self.rig.pancakes(*words, *at)
        assert done.stdout, done.stderr
        return json.loads(done.stdout)

    def runs(self) -> dict[str, int]:
        """The process of each agent that answers."""
        (rows,) = zip(*(self.asked("agent", "info", name) for name in "abc"), strict=True)
        return {row["agent"]: row["process"]["pid"] for row in rows}

    def errors(self) -> list[str]:
        rows = self.asked("doctor", "--no-machine")
        return [f"{row['about']} {row['text']}" for row in rows if row["level"] == "error"]

    def current(self, name: str) -> Path:
        """The version of an agent that is in use on its host."""
        host = self.hosts.hosts[f"robot{'abc'.index(name) + 1}"]
        return host.data / "agents" / "yard" / name / "current"


@pytest.fixture
def yard(rig: Rig, hosts: SshHosts, core: Path, cache: Path) -> Iterator[Yard]:
    rig.environment["XDG_CACHE_HOME"] = str(cache)
    made = Yard(rig, hosts, core)
    data = rig.environment.pop("XDG_DATA_HOME")  # the keys of agents are on their hosts only
    yield made
    rig.environment["XDG_DATA_HOME"] = data
    rig.pancakes("down", str(made.file))


def test_one_command_deploys_a_fleet_with_keys(yard: Yard):
    # Without keys nothing is deployed; without an authority no keys are given out.
    code, said = yard.deploy()
    assert code == 1 and "a needs keys of the fleet yard, and robot1 has none: use pancakes deploy" in said, said
    code, said = yard.deploy("--enrol", "--dry-run")
    assert code == 0, said
    code, said = yard.deploy("--enrol")
    assert code == 1 and "the fleet yard was not founded here" in said, said
    assert not any(host.data.exists() and list(host.data.glob("*/*")) for host in yard.hosts.hosts.values())

    authority = yard.rig.keys.authority("yard")
    authority.enrol_with_key("operator", "bob")
    code, said = yard.deploy("--enrol")
    assert code == 0, said
    assert "a has keys of the fleet yard on robot1" in said
    keys = yard.hosts.hosts["robot2"].data / "keys" / "yard" / "b" / "key.pem"
    assert (keys.stat().st_mode & 0o777, keys.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    pids = yard.runs()
    assert set(pids) == set("abc")
    assert yard.errors() == []

    # Each agent can check a roster, although nobody has requested the extra `keys`.
    revoked = yard.rig.pancakes(
        "keys",
        "revoke",
        "bob",
        "laptop stolen",
        "--yes",
        "--at",
        f"127.0.0.1:{yard.ports['a']}",
        "--fleet",
        "yard",
    )
    assert revoked.returncode == 0 and "is known to a, b, c" in revoked.stdout, revoked.stderr

    # The same command again does nothing, at once.
    began_s = time.monotonic()
    code, said = yard.deploy("--enrol")
    took_s = time.monotonic() - began_s
    assert (code, said.count("has the version"), yard.runs()) == (0, 3, pids), said
    assert "new environment" not in said and took_s < AGAIN_S, took_s

    # An invalid configuration is found before anything is deployed, with its line.
    good = (yard.rig.directory / "c.toml").read_text()
    (yard.rig.directory / "c.toml").write_text(good + WALK.replace("broken", "borken"))
    code, said = yard.deploy()
    assert code == 1 and "c.toml:" in said and "borken" in said and "no host was changed" in said, said
    (yard.rig.directory / "c.toml").write_text(good)
    assert yard.runs() == pids

    # Edits by hand on hosts are reported, and replaced by the deployed files.
    edited = yard.current("b") / "agent.toml"
    edited.write_text("this is no TOML")
    (site,) = (yard.current("c") / "environment").resolve().glob("lib/python*/site-packages")
    (site / "yard_walk.py").write_text("raise SystemExit\n")
    before = yard.runs()
    code, said = yard.deploy("--dry-run")
    assert code == 0 and "b its configuration was edited there" in said, said
    assert "robot3 has files that were changed there by hand (yard_walk.py)" in said
    code, said = yard.deploy()
    assert code == 0 and "b runs the version" in said and "(configuration)" in said and "c runs" in said, said
    after = yard.runs()
    assert after["a"] == before["a"] and after["b"] != before["b"] and after["c"] != before["c"]
    assert "no TOML" not in (yard.current("b") / "agent.toml").read_text()
    assert "no TOML" in (yard.current("b").with_name("last") / "agent.toml").read_text()
    code, said = yard.deploy()
    assert (code, said.count("has the version")) == (0, 3), said

    # A host that is off is named; the others can be deployed without it.
    second = plugin_wheel(yard.rig.directory / "2", "2.0")
    yard.hosts.hosts["robot3"].close()
    code, said = yard.deploy(wheel=second)
    assert code == 1 and "robot3 has no SSH server at that port" in said and "--only" in said, said
    code, said = yard.deploy("--only", "a", "--only", "b", wheel=second)
    assert code == 0 and "(yard 1.0 → 2.0, environment)" in said, said
    code, said = yard.deploy("--only", "d")
    assert code == 2 and "no agent 'd' has a host" in said
    assert psutil.pid_exists(after["c"])
    psutil.Process(after["c"]).kill()
