"""`pancakes up --detach` and `pancakes down FILE`: a fleet that runs without a terminal, and its end."""

import errno
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import closing
from pathlib import Path

import psutil
import pytest
from cli.processes import PATIENCE_S, Rig, wait_until_gone
from harness.programs import Program, pancakes, run

from pancakes.tools.launch.detached import LogFile

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'
FLEET = '[fleet]\nname = "test"\n[agent.gate]\n[agent.node]\nafter = ["gate"]\n'


@pytest.fixture
def field(rig: Rig):
    """A fleet of two agents that share a folder; whatever still runs at the end is ended."""
    folder = rig.directory / "field"
    folder.mkdir()
    for name in ("gate", "node"):
        rig.config(name, LOAD, file=f"field/{name}.toml")
    (folder / "fleet.toml").write_text(f"schema = 1\n{FLEET}")
    yield folder
    rig.pancakes("down", "./field")


def up(rig: Rig, *arguments: str) -> dict:
    """Start a fleet in the background; return what the command says at its end."""
    done = rig.pancakes("up", *arguments, "--detach", "--format", "json")
    assert done.returncode == 0, done.stderr
    *before, last = map(json.loads, done.stdout.splitlines())
    assert {it["agent"] for it in before if it.get("event") == "ready"} == {"gate", "node"}
    assert last["event"] == "detached"
    return last


def nothing_runs(rig: Rig) -> bool:
    return "no agent runs on this machine" in rig.pancakes("agent", "list").stderr


def test_up_detached_returns_when_ready_and_down_ends_all(rig: Rig, field: Path):
    found = up(rig, "field")
    assert sorted(found["ready"]) == ["gate", "node"] and found["given_up"] == []
    assert [it["agent"] for it in rig.listed("agent", "list")] == ["gate", "node"]
    again = rig.pancakes("up", "field", "--detach")
    assert again.returncode == 1 and "runs already" in again.stderr
    assert [it["done"] for it in rig.listed("down", "field", "--dry-run")] == ["dry run"] * 2
    assert {it["agent"]: it["done"] for it in rig.listed("down", "field")} == {"gate": "ended", "node": "ended"}
    wait_until_gone(found["process"])
    log = Path(found["log"]).read_text()
    assert "node is ready" in log and "gate has ended (exit code 0)" in log
    nothing = rig.pancakes("down", "field")
    assert nothing.returncode == 0 and "no agent of field runs" in nothing.stderr


def test_down_ends_a_fleet_that_is_always_restarted(rig: Rig, field: Path):
    found = up(rig, "field", "--restart", "always")
    rig.listed("down", "field")
    wait_until_gone(found["process"])
    assert nothing_runs(rig)


def two_files(rig: Rig, last_first: bool = False) -> list[str]:
    files = [rig.config(name, LOAD, file=f"{name}.toml") for name in ("gate", "node")]
    return [str(file) for file in (reversed(files) if last_first else files)]


@pytest.mark.parametrize("other", ["order", "folder", "no names"])
def test_down_ends_the_launcher_however_it_is_named(rig: Rig, other: str):
    found = up(rig, *two_files(rig), "--restart", "always")
    (rig.directory / "link").symlink_to(rig.directory)
    by_link = ["link/gate.toml", "link/node.toml"]
    rig.listed("down", *{"order": two_files(rig, True), "folder": by_link, "no names": []}[other])
    wait_until_gone(found["process"])
    assert nothing_runs(rig)


def test_down_ends_a_launcher_in_the_foreground(rig: Rig):
    gate, _ = two_files(rig)
    running = rig.run("-m", "pancakes.tools.cli.main", "up", gate, "--restart", "always")
    running.hear("gate is ready")
    rig.listed("down", gate)
    assert running.ended() == 0
    assert nothing_runs(rig)


def test_up_detached_without_standard_input_has_its_log(rig: Rig):
    gate, _ = two_files(rig)
    shell = ["sh", "-c", 'exec "$@" <&-', "sh", *pancakes("up", gate, "--detach", "--format", "json")]
    done = run(shell, timeout_s=PATIENCE_S, env=rig.environment, cwd=rig.directory)
    assert done.returncode == 0 and "Traceback" not in done.stderr
    assert "gate is ready" in Path(json.loads(done.stdout.splitlines()[-1])["log"]).read_text()
    rig.listed("down", gate)


def test_up_detached_runs_on_if_nobody_reads_its_output(rig: Rig):
    gate, _ = two_files(rig)
    shell = ["bash", "-c", '"$@" | head -1; exit ${PIPESTATUS[0]}', "sh", *pancakes("up", gate, "--detach")]
    done = run(shell, timeout_s=PATIENCE_S, env=rig.environment, cwd=rig.directory)
    assert done.returncode == 141 and "Exception" not in done.stderr
    assert [it["agent"] for it in rig.listed("down", gate)] == ["gate"]


def test_log_that_cannot_be_written_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(handler: LogFile, record: logging.LogRecord) -> bool:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(LogFile, "shouldRollover", full)
    log, file = logging.Logger("up"), LogFile(tmp_path / "up" / "x.log")
    log.addHandler(file)
    for _ in range(3):
        log.info("a line")
    file.close()
    assert capsys.readouterr().err == f"the log {tmp_path}/up/x.log cannot be written: No space left on device\n"


def test_log_that_was_moved_begins_again(tmp_path: Path):
    path = tmp_path / "up" / "x.log"
    log, file = logging.Logger("up"), LogFile(path)
    log.addHandler(file)
    log.info("first")
    path.rename(tmp_path / "old.log")
    path.parent.rmdir()
    log.info("second")
    file.close()
    assert path.read_text() == "second\n"


def test_launcher_is_found_after_the_directory_of_its_session_was_removed(rig: Rig):
    gate, _ = two_files(rig)
    running = rig.run("-m", "pancakes.tools.cli.main", "up", gate, "--restart", "always")
    running.hear("gate is ready")
    shutil.rmtree(rig.runtime)
    until_s = time.monotonic() + PATIENCE_S
    while not (any(rig.runtime.glob("up-*.json")) and any(rig.runtime.glob("gate.*.json"))):
        assert time.monotonic() < until_s
    rig.listed("down", gate)
    assert running.ended() == 0


def test_down_ends_the_others_if_a_host_cannot_be_reached(rig: Rig, field: Path):
    running = rig.ready("node")
    (field / "fleet.toml").write_text(
        f"schema = 1\n{FLEET}".replace("[agent.gate]", '[agent.gate]\nhost = "gate.invalid"')
    )
    ssh = rig.directory / "ssh"
    ssh.write_text("#!/bin/sh\necho 'ssh: Could not resolve hostname gate.invalid' >&2\nexit 255\n")
    ssh.chmod(0o755)
    done = rig.pancakes("down", "field", PANCAKES_SSH=str(ssh))
    assert done.returncode == 3 and "gate.invalid" in done.stderr and "node" in done.stdout
    assert running.ended() == 0


@pytest.mark.parametrize("verb", ["up", "down"])
def test_an_empty_path_is_not_this_folder(rig: Rig, verb: str):
    two_files(rig)
    done = rig.pancakes(verb, "")
    assert done.returncode == 2 and "'' names nothing" in done.stderr


def test_up_of_a_path_that_is_not_utf8(rig: Rig):
    folder = os.fsdecode(os.fsencode(rig.directory) + b"/f\xff")
    os.mkdir(folder)
    rig.config("gate", LOAD, file=f"{folder}/gate.toml")
    shell = ["sh", "-c", 'exec "$@" f*', "sh"]  # the harness takes only arguments that are UTF-8
    done = run([*shell, *pancakes("up", "--detach")], timeout_s=PATIENCE_S, env=rig.environment, cwd=rig.directory)
    assert done.returncode == 0 and "gate is ready" in done.stderr
    (found,) = rig.listed("agent", "info", "gate")
    assert found["config_file"]["path"] == "f\\udcff/gate.toml"
    shown = rig.pancakes("config", "show", "gate")
    assert shown.returncode == 0 and "f\\udcff/gate.toml:" in shown.stdout
    assert [it["agent"] for it in rig.listed("down", "gate")] == ["gate"]


def test_hang_up_is_ignored_under_nohup(rig: Rig, field: Path):
    slow = "import time\nfrom pancakes import Task\nclass Slow(Task):\n    def on_start(self):\n        time.sleep(2)\n"
    rig.install("slow", "[pancakes.tasks]\nslow.Slow = plugin_slow:Slow\n", slow)
    rig.config("node", '[task.Slow]\ntype = "slow.Slow"\n', file="field/node.toml")
    waiting = Program(["nohup", *pancakes("up", "field", "--detach")], env=rig.environment, cwd=rig.directory)
    until_s = time.monotonic() + PATIENCE_S
    while not any(rig.runtime.glob("node.*.json")):
        assert time.monotonic() < until_s
    waiting.send_signal(signal.SIGHUP)
    assert waiting.wait(PATIENCE_S) == 0
    assert {it["agent"] for it in rig.listed("down", "field")} == {"gate", "node"}


def test_down_ends_one_agent_of_a_fleet_file(rig: Rig, field: Path):
    up(rig, "field")
    assert [it["agent"] for it in rig.listed("down", "field", "node")] == ["node"]
    assert [it["agent"] for it in rig.listed("agent", "list")] == ["gate"]
    unknown = rig.pancakes("down", "field", "nod")
    assert unknown.returncode == 1 and "field has no agent 'nod'. It has gate, node" in unknown.stderr


def test_down_of_a_name_means_the_running_agent_not_a_folder(rig: Rig, field: Path):
    up(rig, "field")
    (rig.directory / "gate").mkdir()
    assert [it["agent"] for it in rig.listed("down", "gate")] == ["gate"]
    folder = rig.pancakes("down", "gate")
    assert folder.returncode != 0 and "gate" in folder.stderr, "now it is a folder without a configuration"


def test_up_detached_fails_as_in_the_foreground(rig: Rig, field: Path):
    rig.config("node", "[clock]\nsped = 1\n", file="field/node.toml")
    bad = rig.pancakes("up", "field", "--detach")
    assert bad.returncode == 4 and "node.toml" in bad.stderr
    missing = rig.pancakes("up", "nowhere", "--detach")
    assert missing.returncode in (2, 4) and "nowhere" in missing.stderr


def test_up_detached_reports_an_agent_that_is_given_up(rig: Rig, field: Path):
    (rig.directory / "full").write_text("a file, not a folder")
    rig.config("node", LOAD, agent=f'state_dir = "{rig.directory / "full"}"', file="field/node.toml")
    done = rig.pancakes("up", "field", "--detach", "--restart", "no")
    assert done.returncode == 1 and "node did not start, and the others run on" in done.stdout
    assert [it["agent"] for it in rig.listed("down", "field")] == ["gate"]


def test_interrupt_while_waiting_ends_the_fleet(rig: Rig, field: Path):
    slow = (
        "import time\nfrom pancakes import Task\nclass Slow(Task):\n    def on_start(self):\n        time.sleep(600)\n"
    )
    rig.install("slow", "[pancakes.tasks]\nslow.Slow = plugin_slow:Slow\n", slow)
    rig.config("node", '[task.Slow]\ntype = "slow.Slow"\n', file="field/node.toml")
    waiting = Program(pancakes("up", "field", "--detach"), env=rig.environment, cwd=rig.directory)
    until_s = time.monotonic() + PATIENCE_S
    while not any(rig.runtime.glob("node.*.json")):
        assert time.monotonic() < until_s
    waiting.send_signal(signal.SIGINT)
    assert waiting.wait(PATIENCE_S) == 130
    assert nothing_runs(rig)


def test_agent_run_is_pancakes_agent(rig: Rig):
    config = rig.config("lamp", LOAD)
    running = rig.run("-m", "pancakes.tools.cli.main", "agent", "run", str(config), "--set", "agent.seed=3")
    running.hear("lamp/kernel: ready")
    assert [it["agent"] for it in rig.listed("down", "lamp")] == ["lamp"]
    assert running.ended() == 0
    checked = rig.pancakes("agent", "run", str(config), "--check")
    assert checked.returncode == 0


def test_up_only_starts_one_agent_of_a_fleet_again(rig: Rig, field: Path):
    up(rig, "field", "--restart", "no")
    (gate,) = rig.listed("agent", "info", "gate")
    psutil.Process(gate["process"]["pid"]).kill()
    wait_until_gone(gate["process"]["pid"])
    refused = rig.pancakes("up", "field", "--detach")
    assert refused.returncode == 1 and "to start only the others: --only gate" in refused.stderr
    again = rig.pancakes("up", "field", "--only", "gate", "--detach")
    assert again.returncode == 0, again.stderr
    assert [it["agent"] for it in rig.listed("agent", "list")] == ["gate", "node"]
    assert {it["done"] for it in rig.listed("down", "field")} == {"ended"}
    unknown = rig.pancakes("up", "field", "--only", "gat")
    assert unknown.returncode == 1 and "the fleet has no agent 'gat', did you mean 'gate'?" in unknown.stderr


def test_agents_that_will_not_be_linked_are_named(rig: Rig, field: Path):
    said = "will not be linked"
    assert f"gate, node {said}" in rig.pancakes("up", "field", "--dry-run").stderr
    assert rig.pancakes("config", "check", "field").stderr.count(said) == 2
    rig.config("node", LOAD, agent='peers = ["local://test/gate"]', file="field/node.toml")
    assert said not in rig.pancakes("up", "field", "--dry-run").stderr


def test_up_only_of_a_fleet_with_ports(rig: Rig, field: Path):
    """The launcher of the whole fleet keeps its ports claimed; keys that were made for a run are of that run only."""
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        places = f'listen = "tcp://127.0.0.1:{free.getsockname()[1]}"'
    gate = field / "gate.toml"
    gate.write_text(gate.read_text().replace('listen = "tcp://127.0.0.1:0"', places))
    up(rig, "field")
    assert rig.listed("down", "gate")[0]["done"] == "ended"
    again = rig.pancakes("up", "field", "--only", "gate", "--detach")
    assert again.returncode == 0, again.stderr
    rig.listed("down", "field")

    none = str(rig.directory / "none")

    def without_keys(*arguments: str) -> subprocess.CompletedProcess[str]:
        return rig.pancakes(*arguments, XDG_CONFIG_HOME=none, XDG_DATA_HOME=none)

    assert without_keys("up", "field", "--detach").returncode == 0
    without_keys("down", "gate")
    refused = without_keys("up", "field", "--only", "gate", "--detach")
    assert refused.returncode == 1 and "the fleet test runs with keys that were made for its run" in refused.stderr
    without_keys("down", "field")
