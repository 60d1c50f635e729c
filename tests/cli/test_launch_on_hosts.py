"""`pancakes up` with hosts: real SSH servers, and agents that end with their launcher."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from cli.processes import INSECURE, Rig, Running, is_gone, processes_of_ssh, wait_until_gone
from deploy.ssh_hosts import BARE, INSTALLED, SshHosts, free_port, make_key, with_sshd

pytestmark = with_sshd
ROBOTS = ("robot1", "robot2", "robot3")


@pytest.fixture
def hosts(rig: Rig) -> Iterator[SshHosts]:
    made = SshHosts()
    rig.environment["PANCAKES_SSH"] = made.ssh
    yield made
    made.close()


@pytest.fixture
def robots(hosts: SshHosts) -> SshHosts:
    """Three hosts with Pancakes."""
    for name in ROBOTS:
        hosts.add(name, f"{INSTALLED}:{BARE}")
    return hosts


def fleet(rig: Rig, hosts: dict[str, str], *, rest: str = "", keys: bool = False) -> Path:
    """Write a fleet file of agents, each with its host (empty: none), that all dial the first one."""
    port = free_port()
    own = "" if keys else INSECURE
    text = 'schema = 1\n[fleet]\nname = "yard"\n'
    for index, (name, host) in enumerate(hosts.items()):
        place = (
            f'listen = "tcp://127.0.0.1:{port}"'
            if index == 0
            else f'peers = ["tcp://127.0.0.1:{port}"]\nlisten = "tcp://127.0.0.1:0"'
        )
        (rig.directory / f"{name}.toml").write_text(f'schema = 1\n[agent]\nname = "{name}"\n{place}\n{own}{rest}')
        text += f"[agent.{name}]\n" + (f'host = "{host}"\n' if host else "") + ('after = ["a"]\n' if index else "")
    path = rig.directory / "yard.toml"
    path.write_text(text)
    return path


def pid_of(line: str) -> int:
    """Return the process in a line such as `a runs as process 12 on robot1`."""
    words = line.split()
    return int(words[words.index("process") + 1])


def ready(running: Running, *names: str) -> dict[str, int]:
    """Wait until agents are ready; return their processes."""
    pids: dict[str, int] = {}
    left = set(names)
    while left or len(pids) < len(names):
        line = running.hear(" ")
        name, _, rest = line.partition(" ")
        if rest.startswith("runs as process"):
            pids[name] = pid_of(line)
        elif rest == "is ready":
            left.discard(name)
    return pids


def test_launch_runs_a_fleet_on_three_hosts_and_here(rig: Rig, robots: SshHosts):
    path = fleet(rig, {"a": "robot1", "b": "robot2", "c": "robot3", "d": ""}, keys=True)
    running = rig.launch(path)
    pids = ready(running, *"abcd")
    homes = [psutil.Process(pids[name]).environ()["HOME"] for name in "abc"]
    assert homes == [str(robots.hosts[name].home) for name in ROBOTS]
    assert [path.name for path in robots.hosts["robot2"].home.glob(".local/state/pancakes/*/*")] == ["b"]
    rows = rig.listed("agent", "info", "d")
    assert {peer["name"] for peer in rows[0]["mesh"]["peers"]} >= {"a"}  # with keys of the run, over TCP

    code, took_s = running.signalled(signal.SIGINT)

    assert (code, took_s < 6.0) == (0, True), running.everything()
    said = running.everything()
    assert "a has ended (exit code 0)" in said
    assert "a | " in said and "c | " in said and "a runs as process" in said
    assert said.index("b has ended") < said.index("a has ended")
    wait_until_gone(*pids.values())
    assert not list(robots.hosts["robot1"].folder.glob("**/*.toml"))


@pytest.mark.parametrize("victim", ["launcher", "connection"])
def test_launch_ends_with_its_agents_on_hosts(rig: Rig, robots: SshHosts, victim: str):
    running = rig.launch(fleet(rig, {"a": "robot1", "b": "robot2"}), "--restart", "no")
    pids = list(ready(running, "a", "b").values())
    if victim == "launcher":
        running.process.kill()
        wait_until_gone(*pids)
        return
    (ssh,) = processes_of_ssh(running.pid, "robot2")
    ssh.kill()
    running.hear("b has ended (the connection to robot2 is lost")
    wait_until_gone(pids[1])
    assert not is_gone(pids[0])


def test_launch_restarts_agents_on_hosts(rig: Rig, robots: SshHosts):
    running = rig.launch(fleet(rig, {"a": "robot1", "b": "robot2"}))
    running.hear("b is ready")
    (ssh,) = processes_of_ssh(running.pid, "robot2")
    ssh.kill()
    running.hear("and is started again")
    again = pid_of(running.hear("b runs as process"))
    running.hear("b is ready")
    psutil.Process(again).kill()
    running.hear("b has ended (ended by SIGKILL) and is started again")
    running.hear("b is ready")
    assert running.signalled(signal.SIGTERM)[0] == 0


def test_launch_fresh_clears_agents_on_hosts(rig: Rig, robots: SshHosts):
    path = fleet(rig, {"a": "robot1"})
    first = rig.launch(path)
    ready(first, "a")
    first.signalled(signal.SIGTERM)
    (state,) = robots.hosts["robot1"].home.glob(".local/state/pancakes/yard/a")
    (identity,) = state.glob("identity.*")
    before = identity.read_bytes()
    again = rig.launch(path, "--fresh", "--yes")
    ready(again, "a")
    assert identity.read_bytes() != before


def test_launch_begins_missions_on_all_hosts_at_once(rig: Rig, robots: SshHosts):
    path = fleet(rig, {"a": "robot1", "b": "robot2", "d": ""}, rest="[clock]\nhold = true\n")
    running = rig.launch(path)
    running.hear("the mission of a, b, d begins")
    assert running.signalled(signal.SIGTERM)[0] == 0


def test_launch_kills_a_hanging_agent_on_a_host(rig: Rig, robots: SshHosts):
    running = rig.launch(fleet(rig, {"a": "robot1"}))
    pid = pid_of(running.hear("a runs as process"))
    running.hear("a is ready")
    psutil.Process(pid).suspend()
    code, took_s = running.signalled(signal.SIGINT)
    assert (code, took_s < 7.0) == (0, True)
    wait_until_gone(pid)


def test_down_ends_agents_on_hosts(rig: Rig, robots: SshHosts):
    path = fleet(rig, {"a": "robot1", "b": "robot2", "d": ""})
    running = rig.launch(path)
    pids = ready(running, "a", "b", "d")
    asked = rig.listed("down", str(path), "--dry-run")
    assert [(row["agent"], row["host"]) for row in asked] == [("d", ""), ("b", "robot2"), ("a", "robot1")]
    one = rig.pancakes("down", str(path), "b")
    assert (one.returncode, "b" in one.stdout, "a" in one.stdout.split()) == (0, True, False), one.stderr
    running.hear("b has ended (exit code 0)")

    psutil.Process(pids["a"]).suspend()
    ended = rig.pancakes("down", str(path), "--timeout", "1")
    assert ended.returncode == 3 and "a has not ended on robot1 within 1 s" in ended.stderr
    psutil.Process(pids["a"]).resume()  # it was told by a signal, too
    wait_until_gone(*pids.values())
    assert running.ended() == 0
    assert "no agent of" in rig.pancakes("down", str(path)).stderr


def test_tunnel_to_an_agent_ends_with_its_program(rig: Rig, robots: SshHosts):
    program = """
import sys, time
from pathlib import Path
from pancakes.tools.launch.fleet_file import make_fleet
from pancakes.tools.launch.remote_hosts import open_hosts
from pancakes.tools.launch.remote_hosts import tunnels

with open_hosts(make_fleet([Path(sys.argv[1])], (), None, None)) as hosts, tunnels(hosts.values()) as ways:
    print("is open", list(ways), file=sys.stderr, flush=True)
    time.sleep(60)
"""
    running = rig.run("-c", program, str(fleet(rig, {"a": "robot1"})))
    running.hear("is open ['a']")
    children = psutil.Process(running.pid).children()
    assert len(children) == 2
    running.process.kill()
    wait_until_gone(*(it.pid for it in children))


@pytest.mark.parametrize("trouble", ["away", "key", "host key", "python", "pancakes", "running"])
def test_launch_reports_an_unusable_host(rig: Rig, hosts: SshHosts, trouble: str):
    hosts.add("robot1", f"{INSTALLED}:{BARE}")
    path = f"{INSTALLED}:{BARE}"
    if trouble == "python":
        folder = hosts.folder / "old"
        folder.mkdir()
        (folder / "python3").write_text('#!/bin/sh\n[ "$1" = -V ] && echo Python 3.9.2\nexit 1\n')
        (folder / "python3").chmod(0o755)
        (folder / "sh").symlink_to("/bin/sh")
        path = str(folder)
    two = hosts.add("robot2", BARE if trouble == "pancakes" else path)
    file = fleet(rig, {"a": "robot1", "b": "robot2"})
    if trouble == "away":
        two.close()
    if trouble == "key":
        (hosts.folder / "user_key").unlink()
        (hosts.folder / "user_key.pub").rename(hosts.folder / "another.pub")
        make_key(hosts.folder / "user_key")
        (hosts.folder / "user_key.pub").unlink()
        (hosts.folder / "another.pub").rename(hosts.folder / "user_key.pub")
    if trouble == "host key":
        (two.folder / "known").write_text("")
    if trouble == "running":
        first = rig.launch(file)
        first.hear("b is ready")
    expected = {
        "away": "robot2 has no SSH server at that port (ssh: connect to host 127.0.0.1 port",
        "key": "robot2 does not accept your key",
        "host key": "robot2 shows a host key that is not known here",
        "python": "robot2: Pancakes needs Python 3.11 or newer, and this host has only Python 3.9.2: install",
        "pancakes": "robot2 has no Pancakes to run b with: install it with pancakes deploy",
        "running": "the agent b of the fleet yard already runs on robot2 (process",
    }[trouble]

    found = rig.pancakes("up", str(file))

    assert found.returncode == 1 and expected in found.stderr, found.stderr
    assert "Traceback" not in found.stderr and "runs as process" not in found.stderr
