"""Hosts whose shell prints odd output, or that accept `ssh` and stay silent."""

from __future__ import annotations

import signal
import socket
import time
from pathlib import Path

import psutil
import pytest
from cli.processes import INSECURE, PATIENCE_S, Rig, processes_of_ssh
from deploy.ssh_hosts import BARE, INSTALLED, SshHosts, free_port, with_sshd

from pancakes.errors import UnreachableError
from pancakes.tools.launch.ssh import HostLink

pytestmark = with_sshd
NOISE = {
    "title": r"printf '\033]0;robot1\007'",
    "welcome": 'echo welcome; echo \'{"id": 1, "result": 7}\'',
    "long": "head -c 300000 /dev/zero | tr '\\0' x; printf 'no end'",
    "bytes": "head -c 20000 /dev/urandom",
    "commands": "set -x -v; PS4='+ '; exec 2>&1",
    "errors": "echo 'permission denied, please try again' >&2",
    "reader": 'read -t 0.3 line; echo "$line"',
    "background": "(for i in 1 2 3 4 5 6 7 8 9; do printf 'still here '; sleep 0.1; done) &",
}


def bashrc(hosts: SshHosts, text: str, name: str = "robot1") -> None:
    host = hosts.add(name, f"{INSTALLED}:{BARE}")
    for file in (".bashrc", ".profile", ".zshenv"):
        (host.home / file).write_text(f"{text}\n")


@pytest.mark.parametrize("noise", NOISE)
def test_shell_output_of_a_host_is_ignored(hosts: SshHosts, noise: str):
    bashrc(hosts, NOISE[noise])
    link = HostLink("robot1")
    for _ in range(3):
        assert link.obtain("look", 10.0, fleet_of={})["python"][0] == 3
    many = {f"wheel{number:05}": "1" for number in range(20_000)}
    assert link.obtain("missing", 10.0, wheels=many) == list(many)
    link.close()
    assert "key" not in link.lost


def test_fleet_runs_on_a_host_whose_shell_prints(rig: Rig, hosts: SshHosts):
    bashrc(hosts, NOISE["title"])
    running = rig.launch(fleet(rig, ["robot1"]))
    running.hear("a0 is ready")
    ended = rig.pancakes("down", str(rig.directory / "yard.toml"))
    assert ended.returncode == 0, ended.stderr
    assert running.ended() == 0


def fleet(rig: Rig, names: list[str]) -> Path:
    text = 'schema = 1\n[fleet]\nname = "yard"\n'
    for number, name in enumerate(names):
        own = f'schema = 1\n[agent]\nname = "a{number}"\nlisten = "tcp://127.0.0.1:{free_port()}"\n{INSECURE}'
        (rig.directory / f"a{number}.toml").write_text(own)
        text += f'[agent.a{number}]\nhost = "{name}"\n'
    path = rig.directory / "yard.toml"
    path.write_text(text)
    return path


def test_silent_host_is_reported(hosts: SshHosts):
    bashrc(hosts, "echo 'waiting for the home directory' >&2; sleep 600")
    link = HostLink("robot1")
    with pytest.raises(
        UnreachableError, match=r"robot1 does not answer within 5 s \(waiting for the home directory\): see"
    ):
        link.obtain("look", 5.0, fleet_of={})
    assert link.lost


def test_host_that_falls_silent_is_reported(hosts: SshHosts, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pancakes.tools.launch.ssh.SILENT_S", 0.5)
    bashrc(hosts, "")
    link = HostLink("robot1")
    link.obtain("look", 20.0, fleet_of={})
    (there,) = [it for it in psutil.process_iter() if link_of(it, hosts, "python")]
    there.suspend()
    with pytest.raises(UnreachableError, match="robot1 does not answer within 0.5 s"):
        link.obtain("look", fleet_of={})
    there.kill()


def test_port_without_an_ssh_server_is_reported(hosts: SshHosts, monkeypatch: pytest.MonkeyPatch):
    with socket.create_server(("127.0.0.1", 0)) as mute:
        hosts.add("robot1", BARE).port = mute.getsockname()[1]
        hosts.write_config()
        monkeypatch.setenv("PANCAKES_SSH", f"{hosts.ssh} -o ConnectTimeout=1")
        with pytest.raises(UnreachableError, match="robot1 does not answer .*banner"):
            HostLink("robot1").obtain("look", 20.0, fleet_of={})


def test_agents_on_a_silent_host_end(rig: Rig, hosts: SshHosts):
    bashrc(hosts, "")
    program = "from pancakes.tools.launch import remote_hosts, ssh\n"
    program += "ssh.SILENT_S = 5.0\nremote_hosts.ALIVE_S = 0.5\n"
    program += "from pancakes.tools.cli.main import pancakes\npancakes()\n"
    running = rig.run("-c", program, "up", str(fleet(rig, ["robot1"])), "--restart", "no", whole=True)
    running.hear("a0 is ready")
    (there,) = [it for it in psutil.process_iter() if link_of(it, hosts, "")]
    there.suspend()
    running.hear("a0 has ended (robot1 does not answer within 5 s")
    there.kill()


def link_of(process: psutil.Process, hosts: SshHosts, name: str) -> bool:
    try:
        home = process.environ().get("HOME")
        is_link = home == str(hosts.hosts["robot1"].home) and "-u" in process.cmdline()
        return is_link and process.name().startswith(name)
    except psutil.Error:
        return False


@pytest.mark.parametrize("verb", ["up", "deploy", "down"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_ended_command_leaves_no_ssh_process(rig: Rig, hosts: SshHosts, verb: str, number: int):
    names = ["robot1", "robot2", "robot3"]
    for name in names:
        bashrc(hosts, "sleep 600", name)
    path = fleet(rig, names)
    words = {"down": ("down",), "up": ("up",), "deploy": ("deploy",)}[verb]
    running = rig.run("-m", "pancakes.tools.cli.main", *words, str(path))
    until_s = time.monotonic() + PATIENCE_S
    while len(children := processes_of_ssh(running.pid)) < len(names):
        assert time.monotonic() < until_s, running.so_far()
        time.sleep(0.02)
    _, took_s = running.signalled(number)
    assert took_s < 4.0
    gone, left = psutil.wait_procs(children, PATIENCE_S)
    assert not left and len(gone) == len(names)
