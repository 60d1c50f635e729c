"""`pancakes deploy`: real SSH servers, wheels, environments, managers and agents."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from cli.processes import INSECURE, Rig, processes_of_ssh
from deploy.deploying import deploy
from deploy.plugin_wheels import plugin_wheel
from deploy.ssh_hosts import BARE, SshHost, SshHosts, free_port, with_sshd
from deploy.user_systemd import RUNTIME, UserSystemd

from pancakes.tools.launch.ssh import HostError, HostLink

pytestmark = with_sshd
PYENV = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"


def other_python() -> str:
    """Return a Python of this machine of another minor version than this one; empty: there is none."""
    others = [minor for minor in (12, 13, 11) if minor != sys.version_info.minor]
    for minor in others:
        for place in (f"python3.{minor}", *map(str, sorted(PYENV.glob(f"3.{minor}.*/bin/python3.{minor}")))):
            asked = [place, "-c", "import sys, venv; print(sys.executable)"]
            try:
                done = subprocess.run(asked, capture_output=True, text=True)
            except OSError:
                continue
            if done.returncode == 0:
                return os.path.realpath(done.stdout.strip())
    return ""


OTHER = other_python()
WALK = '[task.Walk]\ntype = "yard.Walk"\nrestart = { policy = "no" }\n'


@pytest.fixture
def fleet(rig: Rig, cache: Path) -> Path:
    """A fleet file of three agents, each with its host; the first has a task."""
    rig.environment["XDG_CACHE_HOME"] = str(cache)
    port = free_port()
    text = 'schema = 1\n[fleet]\nname = "yard"\n'
    for index, name in enumerate("abc"):
        dials = f'peers = ["tcp://127.0.0.1:{port}"]\n' if index else ""
        own = f'schema = 1\n[agent]\nname = "{name}"\nlisten = "tcp://127.0.0.1:{0 if index else port}"\n{dials}'
        device = '[device.load]\ndriver = "host.load"\nrate_hz = 1\n'
        (rig.directory / f"{name}.toml").write_text(f"{own}{INSECURE}{device}{'' if index else WALK}")
        text += f'[agent.{name}]\nhost = "robot{index + 1}"\n'
    path = rig.directory / "yard.toml"
    path.write_text(text)
    (rig.directory / "part.toml").write_text('schema = 1\n[fleet]\nname = "yard"\n[agent.b]\nhost = "robot2"\n')
    return path


def disturbed(rig: Rig, trouble: str, *arguments: str | Path) -> tuple[int, str]:
    """Run the verb, and disturb it once the first agent has its version; return the exit code and the output."""
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "deploy", *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=rig.environment, cwd=rig.directory)
    assert process.stderr is not None
    with process, process.stderr:
        said = []
        for line in process.stderr:
            said.append(line)
            if not line.startswith("a runs the version"):
                continue
            if trouble == "person":
                process.send_signal(signal.SIGINT)
            else:
                (ssh,) = [it for it in processes_of_ssh(process.pid, "robot2") if "-L" not in it.cmdline()]
                ssh.kill()
    return process.returncode, "".join(said)


def files_of(host: SshHost) -> set[str]:
    """Return the files of Pancakes on a host, without those that a running agent writes."""
    data = host.data
    kept = [*data.glob("*/*"), *data.glob("agents/*/*/versions/*")]
    links = [
        f"{link.relative_to(data)} -> {os.readlink(link)}" for link in data.glob("agents/*/*/*") if link.is_symlink()
    ]
    return {*(str(it.relative_to(data)) for it in kept), *links}


def tasks(rig: Rig, fleet: Path) -> dict[str, str]:
    """Return which agent runs each user task, by asking the first agent."""
    port = (fleet.parent / "a.toml").read_text().split("127.0.0.1:")[1].split('"')[0]
    rows: Any = json.loads(
        rig.pancakes("task", "list", "--at", f"127.0.0.1:{port}", "--fleet", "yard", "--format", "json").stdout
    )
    return {row["task"]: row["agent"] for row in rows if row["service"] == "client" and row["state"] == "running"}


def doctor(rig: Rig, fleet: Path) -> str:
    port = (fleet.parent / "a.toml").read_text().split("127.0.0.1:")[1].split('"')[0]
    return rig.pancakes("doctor", "--no-machine", "--at", f"127.0.0.1:{port}", "--fleet", "yard").stdout


@pytest.fixture
def robots(hosts: SshHosts) -> Iterator[SshHosts]:
    """Three hosts: one with systemd and one with another Python, if this machine has them."""
    hosts.add("robot1", BARE)
    home = hosts.folder / "robot2" / "home"
    home.mkdir(parents=True)
    manager: UserSystemd | None = None
    try:
        manager = UserSystemd(home)
    except pytest.skip.Exception:
        hosts.add("robot2", BARE)
    else:
        hosts.add("robot2", BARE, {"XDG_RUNTIME_DIR": RUNTIME}, manager.pid)
    path = BARE
    if OTHER:
        folder = hosts.folder / "bin"
        folder.mkdir()
        (folder / "python3").symlink_to(OTHER)
        (folder / "sh").symlink_to("/bin/sh")
        path = str(folder)
    hosts.add("robot3", path)
    yield hosts
    if manager is not None:
        manager.close()


@pytest.mark.timeout(1200)
def test_fleet_is_deployed_switched_and_rolled_back(rig: Rig, robots: SshHosts, fleet: Path, core: Path):
    first, second = plugin_wheel(rig.directory / "1", "1.0"), plugin_wheel(rig.directory / "2", "2.0")
    ours = ("--wheels", core, "--calm", "1s")
    try:
        # A dry run shows the plan and changes nothing.
        shown = deploy(rig, fleet, *ours, "--wheels", first, "--dry-run", "--format", "json")
        assert shown.returncode == 0, shown.stderr
        rows = json.loads(shown.stdout)
        assert [(row["agent"], row["host"], row["what"]) for row in rows] == [
            ("a", "robot1", "new"),
            ("b", "robot2", "new"),
            ("c", "robot3", "new"),
        ]
        assert rows[0]["brought_mb"] > 1.0 and not any(files_of(host) for host in robots.hosts.values())

        done = deploy(rig, fleet, *ours, "--wheels", first)
        assert done.returncode == 0, done.stderr
        assert tasks(rig, fleet) == {"Walk": "a"}
        assert "different versions" not in doctor(rig, fleet)
        if OTHER:
            (python,) = {path.name for path in robots.hosts["robot3"].data.glob("environments/*/lib/*")}
            assert python == Path(OTHER).name
        again = deploy(rig, fleet, *ours, "--wheels", first)
        assert again.returncode == 0 and "a has the version" in again.stderr and "runs the version" not in again.stderr

        # One agent has another version, which is reported; a task migrates away from the next one, and comes back.
        assert deploy(rig, "part.toml", *ours, "--wheels", second).returncode == 0
        text = doctor(rig, fleet)
        assert "agents of a fleet run different versions: 0.1.0-" in text and (
            " on a, c; " in text or " on b; " in text
        )
        done = deploy(rig, fleet, *ours, "--wheels", second)
        assert done.returncode == 0, done.stderr
        assert "a gives Walk to c" in done.stderr  # b has another version already
        assert "a gets Walk back from c" in done.stderr, done.stderr
        assert tasks(rig, fleet) == {"Walk": "a"} and "different versions" not in doctor(rig, fleet)

        # One of them does not run as it should: all go back.
        before = {name: files_of(host) for name, host in robots.hosts.items()}
        broken = ("--set", "b:task.Own.type=yard.Walk", "--set", 'b:task.Own.restart={policy="no"}')
        failed = deploy(
            rig,
            fleet,
            *ours,
            "--wheels",
            second,
            "--set",
            "device.load.rate_hz=2",
            *broken,
            "--set",
            "b:task.Own.settings.broken=true",
        )
        assert failed.returncode == 1
        assert "b does not run on robot2 as it should: client/Own is failed" in failed.stderr, failed.stderr
        assert "it has no legs" in failed.stderr and "c runs" not in failed.stderr
        assert "b is back at the version" in failed.stderr and "a is back at the version" in failed.stderr
        assert {name: files_of(host) for name, host in robots.hosts.items()} == before
        assert tasks(rig, fleet) == {"Walk": "a"}

        # A connection that is lost half-way, and a person who calls it off.
        for trouble, expected in (("connection", "the connection to robot2 is lost"), ("person", "is called off")):
            code, said = disturbed(rig, trouble, fleet, *ours, "--wheels", second, "--set", "device.load.rate_hz=2")
            assert code == 1 and expected in said and "a is back at the version" in said, said
            assert {name: files_of(host) for name, host in robots.hosts.items()} == before
        assert tasks(rig, fleet) == {"Walk": "a"}

        # A configuration that is invalid with the new wheels stops the deployment before anything is touched.
        pids = running(robots)
        failed = deploy(rig, fleet, *ours, "--wheels", second, "--set", "c:task.Own.type=yard.Run")
        assert failed.returncode == 1 and "no host was changed" in failed.stderr and "yard.Run" in failed.stderr
        assert {name: files_of(host) for name, host in robots.hosts.items()} == before and running(robots) == pids
    finally:
        ended = rig.pancakes("down", str(fleet))
    assert ended.returncode == 0, ended.stderr
    assert running(robots) == {}

    # A launch runs the deployed version, too.
    launched = rig.launch(fleet)
    left = set("abc")
    while left:
        left.discard(launched.hear(" is ready").split()[0])
    assert launched.signalled(signal.SIGINT)[0] == 0


def running(hosts: SshHosts) -> dict[str, int]:
    """Return the processes of agents below the homes of hosts."""
    found = {}
    for process in psutil.process_iter():
        try:
            words = process.cmdline()
            homes = [name for name, host in hosts.hosts.items() if process.environ().get("HOME") == str(host.home)]
        except psutil.Error:
            continue
        if homes and any(word.endswith("agent.toml") for word in words):
            found[homes[0]] = process.pid
    return found


@pytest.mark.parametrize("trouble", ["away", "disk", "running"])
def test_unusable_host_leaves_the_fleet_unchanged(rig: Rig, hosts: SshHosts, fleet: Path, core: Path, trouble: str):
    for name in ("robot1", "robot2", "robot3"):
        hosts.add(name, BARE)
    three = hosts.hosts["robot3"]
    mounted = False
    expected = "robot3 has no SSH server at that port"
    try:
        if trouble == "away":
            three.close()
        elif trouble == "disk":
            three.data.mkdir(parents=True)
            mounted = (
                subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(three.data)]).returncode == 0
            )
            if not mounted:
                pytest.skip("a small disk can be had by root alone")
            expected = f"robot3 has 25 MB left on its disk ({three.data}) and needs"
        else:
            (rig.directory / "c.toml").write_text((rig.directory / "c.toml").read_text() + WALK)
            rig.install("yard", "[pancakes.tasks]\nyard.Walk = plugin_yard:Walk\n", "")
            environment = {**rig.environment, "HOME": str(three.home), "XDG_RUNTIME_DIR": str(three.runtime)}
            rig.environment = {key: value for key, value in environment.items() if key != "PANCAKES_RUNTIME_DIR"}
            agent = rig.agent(rig.directory / "c.toml", "--set", "agent.fleet=yard", "--set", "task={}")
            agent.hear("/kernel: ready")
            expected = f"c already runs on robot3 (process {agent.pid}), not from a deployment"

        failed = deploy(rig, fleet, "--wheels", core, "--wheels", plugin_wheel(rig.directory / "1", "1.0"))

        assert failed.returncode == 1 and expected in failed.stderr, failed.stderr
        assert not any(files_of(host) for host in hosts.hosts.values())
    finally:
        if mounted:
            subprocess.run(["umount", str(three.data)], check=True)


def test_second_deployment_on_a_host_is_refused(rig: Rig, hosts: SshHosts, fleet: Path, core: Path):
    for name in ("robot1", "robot2", "robot3"):
        hosts.add(name, BARE)
    link = HostLink("robot2")
    link.obtain("lock")
    failed = deploy(rig, fleet, "--wheels", core)
    link.close()
    assert failed.returncode == 1
    assert "robot2 is busy with another deployment: wait until it has ended" in failed.stderr


def test_full_disk_is_reported_with_its_host(hosts: SshHosts):
    host = hosts.add("robot1", BARE)
    host.data.mkdir(parents=True)
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(host.data)]).returncode:
        pytest.skip("a small disk can be had by root alone")
    link = HostLink("robot1")
    try:
        with pytest.raises(HostError, match="robot1 has no room left on its disk.*: make room there"):
            link.send_file("large.whl", "0", bytes(3_000_000))
        link.obtain("clean")
        assert not files_of(host)
    finally:
        link.close()
        subprocess.run(["umount", str(host.data)], check=True)


def test_fleet_without_hosts_is_refused_with_advice(rig: Rig, fleet: Path):
    failed = deploy(rig, rig.directory / "b.toml")
    assert failed.returncode == 1 and 'add host = "pi@robot1"' in failed.stderr
