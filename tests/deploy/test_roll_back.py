"""After a rollback, the same tasks run as before the deployment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cli.processes import INSECURE, Rig
from deploy.deploying import deploy
from deploy.plugin_wheels import MODULE, plugin_wheel
from deploy.ssh_hosts import BARE, SshHosts, free_port, with_sshd

pytestmark = with_sshd
WALK = '[task.Walk]\ntype = "yard.Walk"\nrestart = { policy = "no" }\n'
BROKEN = MODULE.replace(
    "    @every", '    def on_start(self):\n        raise ValueError("it has no legs")\n\n    @every'
)
PATIENCE_S = 20.0


class Yard:
    """A fleet of one agent on one host, with a task."""

    def __init__(self, rig: Rig, task: str = WALK) -> None:
        self.rig = rig
        self.port = free_port()
        own = f'schema = 1\n[agent]\nname = "a"\nlisten = "tcp://127.0.0.1:{self.port}"\n'
        (rig.directory / "a.toml").write_text(f"{own}{INSECURE}{task}")
        self.file = rig.directory / "yard.toml"
        self.file.write_text('schema = 1\n[fleet]\nname = "yard"\n[agent.a]\nhost = "robot1"\n')

    def asked(self, *words: str) -> Any:
        at = ("--at", f"127.0.0.1:{self.port}", "--fleet", "yard", "--format", "json")
        done = self.rig.pancakes(*words, *at)
        assert done.stdout, done.stderr
        return json.loads(done.stdout)

    def state(self, task: str) -> str:
        (row,) = [row for row in self.asked("task", "list") if row["task"] == task]
        return str(row["state"])

    def errors(self) -> list[str]:
        rows = self.asked("doctor", "--no-machine")
        return [f"{row['about']} {row['text']}" for row in rows if row["level"] == "error"]


@pytest.fixture
def yard(rig: Rig, hosts: SshHosts, cache: Path) -> Yard:
    rig.environment["XDG_CACHE_HOME"] = str(cache)
    hosts.add("robot1", BARE)
    return Yard(rig)


@pytest.mark.timeout(300)
def test_roll_back_restores_running_tasks(rig: Rig, yard: Yard, core: Path):
    sound, broken = plugin_wheel(rig.directory / "1", "1.0"), plugin_wheel(rig.directory / "2", "2.0", BROKEN)
    ours = (yard.file, "--wheels", core, "--calm", "1s")
    try:
        # A bad first version leaves nothing to go back to, and the next one runs.
        failed = deploy(rig, *ours, "--wheels", broken)
        assert failed.returncode == 1 and "it has no legs" in failed.stderr, failed.stderr
        done = deploy(rig, *ours, "--extra", "record", "--wheels", sound)
        assert done.returncode == 0, done.stderr
        assert yard.state("Walk") == "running"

        yard.asked("record", "start", "a", "--channel", "system")
        failed = deploy(rig, *ours, "--wheels", broken)
        assert failed.returncode == 1 and "it has no legs" in failed.stderr, failed.stderr
        assert (yard.state("Walk"), yard.state("Recorder")) == ("running", "running"), failed.stderr
        assert yard.errors() == []
        assert [row["done"] for row in yard.asked("record", "list")] == ["recording"]
        (recorder,) = yard.asked("task", "info", "a/log/Recorder")
        assert recorder["settings"]["channels"] == ["system"]
    finally:
        rig.pancakes("down", str(yard.file))
