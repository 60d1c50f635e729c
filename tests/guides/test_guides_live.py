"""The commands of guides, as they stand there, run by agents and programs on this machine.

What a guide says for another machine is replaced: its addresses, and what would take minutes.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.machines import PASSWORD, Machine, machines
from cli.processes import READY, Rig, Running
from harness.guide import ROOT, example
from harness.programs import AGENT, PANCAKES, run

CONFIGS = ROOT / "plugins" / "pancakes-encirclement" / "pancakes_encirclement" / "configs" / "encirclement"
PATROL = """
from dataclasses import dataclass

from pancakes.task import Task, every


class Watch(Task):
    @dataclass
    class Settings:
        radius_m: float = 1.0

    @every(hz=10)
    def look(self, tick):
        pass
"""
PATROL_ENTRY = "[pancakes.tasks]\npatrol.Watch = plugin_patrol:Watch\n"
LIMIT_S = 120.0


class Reader:
    """Somebody who types what a guide says, in a folder with the files that it speaks of."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig = rig
        self.folder = folder

    def types(self, command: str, *more: str, code: int = 0) -> str:
        """Runs a command of a guide to its end, with further arguments; returns what it printed."""
        program, *words = shlex.split(command, comments=True)
        module = {"pancakes": PANCAKES, "pancakes-agent": AGENT}[program]
        ended = run(
            [sys.executable, "-m", module, *words, *more],
            timeout_s=LIMIT_S,
            env=self.rig.environment,
            cwd=self.folder,
        )
        assert ended.returncode == code, f"{command}: {ended.stdout}{ended.stderr}"
        return ended.stdout + ended.stderr


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    rig = Rig(tmp_path)
    rig.install("patrol", PATROL_ENTRY, PATROL)
    try:
        yield Reader(rig, tmp_path)
    finally:
        rig.close()


# configuration.md ------------------------------------------------------------------------------------------------


def test_configuration_files_are_checked(reader: Reader):
    (reader.folder / "agent1.toml").write_text(example("docs/configuration.md", "schema = 1\n\n[agent]\n").text)
    runs, checks, sets = example("docs/configuration.md", "pancakes-agent --config").commands
    reader.rig.keys.of_agent("default", "agent1")
    reader.types(checks)
    reader.types(sets, "--check")
    agent = reader.rig.run("-m", AGENT, *shlex.split(runs)[1:], "--set", "agent.listen=tcp://127.0.0.1:0")
    agent.hear(READY)


def test_configuration_of_created_tasks_is_kept(reader: Reader):
    create, show, remove = example("docs/configuration.md", "pancakes task create").commands
    reader.rig.ready("agent1")
    reader.types(create)
    command, _, file = show.partition(" > ")
    (reader.folder / file).write_text(reader.types(command))
    reader.types(f"pancakes-agent --config {file} --check")
    text = (reader.folder / file).read_text()
    assert "[task.Watch]" in text and "patrol.Watch" in text and "radius_m = 0.8" in text
    reader.types(remove)
    assert [row["task"] for row in reader.rig.listed("task", "list", "agent1") if row["task"] == "Watch"] == []


def test_configuration_of_fleets_is_launched(reader: Reader):
    folder, files, dry = example("docs/configuration.md", "pancakes up").commands
    shutil.copytree(CONFIGS, reader.folder / "configs" / "encirclement")
    for name in ("world", "robot"):
        reader.rig.config(name)
    for command in (folder, files):
        assert "world" in reader.types(command, "--local", "--dry-run")
    assert "agent2" in reader.types(dry, "--local")


# recordings.md ---------------------------------------------------------------------------------------------------


def test_recordings_are_made(reader: Reader):
    """Of an agent that records from its start on, and then only what one task says."""
    _, agent, start, listing, stop, info = example("docs/recordings.md", "pancakes demo").commands
    (only,) = example("docs/recordings.md", "pancakes record start --task").commands
    reader.rig.config("agent1")
    reader.rig.run("-m", AGENT, *shlex.split(agent, comments=True)[1:]).hear(READY)
    assert "recordings/agent1.mcap" in reader.types(listing)
    reader.types(stop)
    reader.types(start)
    reader.types(stop)
    reader.types(only)
    reader.types(stop)
    assert "agent1-2.mcap" in reader.types(info)


def test_recordings_are_used(reader: Reader):
    """The first 45 s of the mission of the guide, recorded as it says."""
    folder, page = reader.folder, "docs/recordings.md"
    reader.types(example(page, "pancakes demo").commands[0], "--duration", "45", code=1)  # too short for a PASS
    recording = folder / "runs" / "encirclement-1-virtual" / "recording"
    (folder / "runs" / "live").mkdir()
    (folder / "runs" / "live" / "recording").symlink_to(recording)
    shutil.copytree(recording, folder / "recordings")
    (repair,) = example(page, "pancakes record repair").commands
    assert "whole already" in reader.types(repair)
    _, one, task = example(page, "pancakes report").commands
    assert "figures/report.html" in reader.types(one)
    assert shlex.split(task, comments=True)[-1] == "agent1/ScanTarget"
    (kinds,) = example(page, "pancakes why runs/live/recording\n").commands
    assert "each of them answers a packet that was recorded" in reader.types(kinds)
    at, slowest, every = example(page, "pancakes why runs/live/recording --agent").commands
    assert "from the first cause to the command" in reader.types(at)
    assert reader.types(slowest).count("from the first cause to the command") == 3
    assert "agent1" in reader.types(every)
    code = example(page, "from pathlib import Path")
    ended = subprocess.run([sys.executable, "-c", code.text], cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0 and "agent1/client/ScanTarget motors" in ended.stdout, ended.stderr
    begin = "pancakes rerun runs/encirclement-1-virtual/recording ScanTarget"
    (same,) = example(page, f"{begin}\n").commands
    assert "it agrees with the recording" in reader.types(same)
    (other,) = example(page, f"{begin} --stay").commands
    assert "omega_radps was " in reader.types(other, code=1)
    replayed(reader)


def replayed(reader: Reader) -> None:
    """Replays recordings/ into agents that run, as far as a dry run goes, and into two in virtual time."""
    for command in example("docs/recordings.md", "pancakes replay recordings --dry-run").commands:
        if "agent7" in command:
            reader.rig.ready("agent7", fleet="encirclement")
        elif not reader.rig.runtime.is_dir():
            reader.rig.ready("agent1", fleet="encirclement")
        more = () if "--dry-run" in command else ("--dry-run",)
        assert "dry run" in reader.types(command, *more)
    for name in ("common", "agent1", "agent2"):
        shutil.copy(CONFIGS / f"{name}.toml", reader.folder)
    (virtual,) = example("docs/recordings.md", "pancakes replay recordings --config").commands
    reader.types(virtual, "--end", "5s")
    assert sorted(it.name for it in (reader.folder / "again").iterdir()) == ["agent1.mcap", "agent2.mcap"]


# security.md -----------------------------------------------------------------------------------------------------

THERE = "192.168.1.21:7401"
ONCE = f"{PASSWORD}\n"


@pytest.fixture
def garage(tmp_path: Path) -> Iterator[dict[str, Machine]]:
    with machines(tmp_path, ["laptop", "robot1", "robot3", "bob"], "homes") as made:
        found = dict(zip(["laptop", "robot1", "robot3", "bob"], made, strict=True))
        found["laptop"].said("keys", "init", "garage", "--me", "alice", typed=ONCE * 2)
        yield found


def lines_of(block: Any, robot: Machine) -> list[tuple[str, list[str]]]:
    """Returns what is typed in a block of security.md, each line with the machine where that is."""
    found = re.findall(r"^(\w+)\$ pancakes (.*)$", block.text, flags=re.MULTILINE)
    return [(where, shlex.split(line.replace(THERE, robot.address))) for where, line in found]


def test_security_of_two_robots(garage: dict[str, Machine]):
    """A robot and a person come with folders, the person lacks a right, and the operator gets a new key."""
    laptop, robot1 = garage["laptop"], garage["robot1"]
    for name, machine, *role in (("agent1", robot1), ("bob", garage["bob"], "--role", "observer")):
        laptop.said("keys", "enrol", name, *role, "--out", "stick", typed=ONCE)
        laptop.bring("stick", machine)
        machine.said("keys", "join", "stick")
    robot1.agent("agent1").hear(READY)
    ((_, listing),) = lines_of(example("docs/security.md", "laptop$ pancakes agent list"), robot1)
    assert "agent1" in laptop.said(*listing)

    (enrol, join) = lines_of(example("docs/security.md", "laptop$ pancakes keys enrol agent3"), robot1)
    told = laptop.said(*enrol[1], typed=ONCE)
    assert "It contains the private key: remove it here afterwards." in told
    laptop.bring("agent3", garage["robot3"])
    assert "This machine is agent3 of the fleet garage" in garage["robot3"].said(*join[1])

    ((_, stop),) = lines_of(example("docs/security.md", "bob$ pancakes task stop"), robot1)
    refused = garage["bob"].pancakes(*stop)
    said = " ".join(refused.stderr.split())
    assert refused.returncode == 1 and "lacks the right 'change' on 'agent1/device/load' (roster 1)" in said

    block = example("docs/security.md", "laptop$ pancakes keys revoke operator/alice")
    for _, words in lines_of(block, robot1):
        if "&&" in words:
            words = words[: words.index("&&")]
        typed = "" if words[:2] == ["keys", "join"] else ONCE
        if words[:2] == ["keys", "revoke"]:  # no agent has heard of it until the last line
            assert laptop.pancakes(*words, typed=typed).returncode == 1
            continue
        told = laptop.said(*words, typed=typed)
    assert "known to agent1" in told


# what-if.md, zenoh.md, releases.md -------------------------------------------------------------------------------


def test_what_if_is_asked(reader: Reader):
    one = reader.rig.ready("robot2")
    peers = f'peers = ["{reader.rig.address(one)}"]'
    reader.rig.ready("robot1", '[task.Planner]\ntype = "patrol.Watch"\n', agent=peers).hear("peer_up peer=robot2")
    move, rate, without, _ = example("docs/what-if.md", "pancakes what-if").commands
    assert "If robot1/client/Planner migrates to robot2" in reader.types(move, "--for", "1s")
    reader.types(rate, "--for", "1s")
    reader.types(without, "--for", "1s")


def test_zenoh_joins_two_agents(reader: Reader):
    pytest.importorskip("zenoh")
    _, router = example("docs/zenoh.md", "pip install").commands
    assert router == example("plugins/pancakes-zenoh/README.md", "pip install").commands[1]
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    running = reader.rig.run("-m", PANCAKES, *shlex.split(router.replace("7447", port))[1:], whole=True)
    assert re.search(rf"The router \w+ listens at tcp/127\.0\.0\.1:{port}\.", running.hear("listens at "))
    text = example("docs/zenoh.md", "schema = 1").text.replace("7447", port)
    agents: dict[str, Running] = {}
    for name, other in (("a", "b"), ("b", "a")):
        reader.rig.keys.of_agent("garage", name)
        changed = text.replace('name = "a"', f'name = "{name}"').replace("zenoh://a:1", f"zenoh://{name}:1")
        changed = changed.replace('peers = ["zenoh://b:1"]', f'peers = ["zenoh://{other}:1"]')
        (reader.folder / f"{name}.toml").write_text(changed)
        agents[name] = reader.rig.agent(reader.folder / f"{name}.toml")
    agents["a"].hear("peer_up peer=b")
    for agent in agents.values():
        agent.signalled(signal.SIGTERM)


def test_releases_say_their_version(reader: Reader):
    (command,) = example("docs/releases.md", "pancakes --version").commands
    assert json.dumps(reader.types(command)).startswith('"pancakes, version 0.1.0')
