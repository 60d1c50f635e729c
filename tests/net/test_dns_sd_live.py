"""Agents find each other by name on a network of their own, and nothing that is announced is a way in.

The counterpart is zeroconf in a process of its own, on another machine of that network.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from harness.two_networks import HOSTS, two_networks
from keys_in_test import KeysInTest

from pancakes.mesh.peers import MOST_OF_PEER

pytest.importorskip("zeroconf")

Process = subprocess.Popen[str]
PATIENCE_S = 40.0
AGENT = "from pancakes.tools.cli.console_scripts import agent; agent()"
PANCAKES = "from pancakes.tools.cli.console_scripts import pancakes; pancakes()"
BROWSE = """
import json, sys
from zeroconf import ServiceBrowser, ServiceListener, Zeroconf
network = Zeroconf([sys.argv[1]])
class Found(ServiceListener):
    def add_service(self, zc, type_, name):
        info = None
        while info is None:
            info = zc.get_service_info(type_, name)
        texts = {key.decode(): value.decode() for key, value in info.properties.items()}
        print(json.dumps([info.port, info.parsed_addresses(), texts]), flush=True)
    def update_service(self, zc, type_, name): pass
    def remove_service(self, zc, type_, name): print(json.dumps(["gone", name]), flush=True)
ServiceBrowser(network, "_pancakes._tcp.local.", Found())
sys.stdin.read()
"""
ANNOUNCE = """
import sys
from zeroconf import ServiceInfo, Zeroconf
host, count, type_ = sys.argv[1], int(sys.argv[2]), "_pancakes._tcp.local."
network = Zeroconf([host])
bad = [{"name": "../../etc", "fleet": "field"}, {"name": "x\\x1b[2J", "fleet": "field"}, {}]
texts = bad + [{"name": f"ghost{it}", "fleet": "field", "version": "1"} for it in range(count)]
for number, text in enumerate(texts):
    more = {"properties": text, "server": "h.local.", "parsed_addresses": [host]}
    info = ServiceInfo(type_, f"it {number}.{type_}", 1000 + number, **more)
    network.registry.async_add(info)
    network.loop.call_soon_threadsafe(network.async_send, network.generate_service_broadcast(info, 120))
print("announced", flush=True)
sys.stdin.read()
"""


class Machines:
    """Two machines with agents of the fleet `field`, which have keys of one authority but name no peers."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder = stack, folder
        self._at = stack.enter_context(two_networks())
        self.keys = KeysInTest(folder / "ours")

    def start(self, machine: int, program: str, *arguments: str, keys: KeysInTest | None = None) -> Process:
        """Starts a Python program on a machine, until the end of the test."""
        environment = {
            **os.environ,
            **(keys or self.keys).environment,
            "PANCAKES_RUNTIME_DIR": str(self._folder / f"run{machine}"),
            "XDG_STATE_HOME": str(self._folder / f"state{machine}"),
        }
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        command = [*self._at[machine], sys.executable, "-c", program, *arguments]
        process = self._stack.enter_context(subprocess.Popen(command, env=environment, **pipes))
        limit = threading.Timer(3 * PATIENCE_S, process.kill)  # then what reads its lines comes to their end
        limit.start()
        self._stack.callback(process.kill)
        self._stack.callback(limit.cancel)
        return process

    def agent(self, machine: int, name: str, keys: KeysInTest | None = None) -> Process:
        (keys or self.keys).of_agent("field", name)
        file = self._folder / f"{name}.toml"
        file.write_text(
            f'schema = 1\n[agent]\nname = "{name}"\nfleet = "field"\nlisten = "tcp://0.0.0.0:7401"\nmdns = true\n'
        )
        return self.start(machine, AGENT, "--config", str(file), keys=keys)

    def ask(self, machine: int, *arguments: str) -> Any:
        """Returns what `pancakes` prints as JSON on a machine; None: it found nothing."""
        out, _ = self.start(machine, PANCAKES, *arguments, "--format", "json").communicate(timeout=PATIENCE_S)
        return json.loads(out) if out.startswith(("[", "{")) else out


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[Machines]:
    with ExitStack() as stack:
        yield Machines(stack, tmp_path)


def line_of(process: Process) -> Any:
    """Returns the next line that a program prints, which is JSON."""
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("["), line
    return json.loads(line)


def until(process: Process, *words: str) -> list[str]:
    """Reads what a program prints until a line has all of the words; returns all lines."""
    assert process.stdout is not None
    lines, end_s = [], time.monotonic() + PATIENCE_S
    for line in process.stdout:
        lines.append(line)
        if all(word in line for word in words):
            return lines
        if time.monotonic() > end_s:
            break
    raise AssertionError("".join(lines))


def test_agents_and_terminals_find_each_other_and_say_no_more_than_they_must(machines: Machines) -> None:
    browsing = machines.start(1, BROWSE, HOSTS[1])
    robot1 = machines.agent(0, "robot1")
    robot2 = machines.agent(1, "robot2")
    until(robot1, "robot2", "is connected")
    found = sorted(line_of(browsing) for _ in range(2))
    assert [[port, hosts, sorted(texts)] for port, hosts, texts in found] == [
        [7401, [host], ["fleet", "name", "version"]] for host in HOSTS
    ]
    both, seen, end_s = [("robot1", ["robot2"]), ("robot2", ["robot1"])], None, time.monotonic() + PATIENCE_S
    while seen != both and time.monotonic() < end_s:  # a command waits 1.5 s for answers, which is little under load
        rows = machines.ask(0, "agent", "list", "--at", "mdns:", "--fleet", "field")
        seen = [(row["agent"], row["neighbours"]) for row in rows] if isinstance(rows, list) else rows
    assert seen == both
    robot2.terminate()
    assert line_of(browsing)[0] == "gone"


def test_what_is_announced_is_no_way_in(machines: Machines, tmp_path: Path) -> None:
    others = KeysInTest(tmp_path / "theirs")
    robot1 = machines.agent(0, "robot1")
    until(robot1, "is announced by mDNS")
    impostor = machines.agent(1, "robot2", others)  # of a fleet of that name which another authority has founded
    until(robot1, "robot2 (Pancakes")
    flood = machines.start(1, ANNOUNCE, HOSTS[1], "60")
    until(flood, "announced")
    until(robot1, "ghost")
    until(impostor, "robot1 (Pancakes")

    (about,) = machines.ask(0, "agent", "info", "robot1")
    met = [it for it in about["mesh"]["addresses"] if not it["static"]]
    assert about["neighbours"] == []
    assert 2 <= len(met) <= MOST_OF_PEER
    assert all(it["address"].startswith(f"tcp://{HOSTS[1]}:") for it in met)
    asked = machines.ask(1, "agent", "list", "--at", "mdns:", "--fleet", "nobody")
    assert "no agent of the fleet nobody announces itself by mDNS" in asked
