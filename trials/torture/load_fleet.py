"""Real agents in processes of their own, loaded by the tasks of `load_tasks`, and watched from outside."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cli.processes import INSECURE, READY, Rig, Running
from torture import load_tasks
from torture.live import free_ports

from pancakes.client import Client, Target
from pancakes.control import Configure

ENTRY_POINTS = "[pancakes.packets]\nload = plugin_load\n\n[pancakes.tasks]\n" + "".join(
    f"load.{name} = plugin_load:{name}\n"
    for name in ("Flood", "QueueReader", "ReliableReader", "SystemReader", "Pulse", "Asker", "Pinger", "Ponger")
)
PATIENCE_S = 30.0

Tasks = Mapping[str, Mapping[str, Any]]
"""Settings of the tasks of an agent, by name; the type is the name up to a dash."""


class LoadedFleet:
    """Agents that listen at free ports of this machine, without keys, so that peers on raw sockets can connect.

    Args:
        directory: the folder for all files.
        tasks: their tasks, by the agent's name.
        peers: the agents that each dials; without an entry: all others.
        addresses: the address of each; None: free ports.

    Attributes:
        running: their processes.
        addresses: where they listen.
        client: a client of the fleet, like a terminal.
    """

    def __init__(
        self,
        directory: Path,
        tasks: Mapping[str, Tasks],
        peers: Mapping[str, Sequence[str]] | None = None,
        addresses: Mapping[str, str] | None = None,
    ) -> None:
        self.directory = directory
        self.rig = Rig(directory)
        self.rig.install("load", ENTRY_POINTS, Path(load_tasks.__file__).read_text())
        ports = free_ports(len(tasks))
        found = {name: f"tcp://127.0.0.1:{port}" for name, port in zip(tasks, ports, strict=True)}
        self.addresses = dict(addresses or found)
        self.running: dict[str, Running] = {}
        self._configs: dict[str, Path] = {}
        for name, mine in tasks.items():
            dialled = (peers or {}).get(name, [self.addresses[other] for other in tasks if other != name])
            self._configs[name] = directory / f"{name}.toml"
            self._configs[name].write_text(self._config(name, mine, dialled))
        try:
            for name in tasks:
                self.start(name)
            for running in self.running.values():
                running.hear(READY)
            self.client = Client(Target(tuple(self.addresses.values()), "load"), timeout_s=PATIENCE_S)
        except BaseException:  # the caller has no object yet that it could close
            self.rig.close()
            raise

    def _config(self, name: str, tasks: Tasks, dialled: Sequence[str]) -> str:
        lines = [
            f'schema = 1\n[agent]\nname = "{name}"\nfleet = "load"\nlisten = "{self.addresses[name]}"',
            f'state_dir = "{self.directory / "state" / name}"\npeers = {json.dumps(list(dialled))}\nbirth_wait_s = 0',
            "[channel.load]",
        ]
        for task, settings in tasks.items():
            kind = task.partition("-")[0]
            own = dict(settings) if kind == "Ponger" else {"file": str(self.file(name, task)), **settings}
            lines += [f'[task.{task}]\ntype = "load.{kind}"', f"[task.{task}.settings]"]
            lines += [f"{key} = {json.dumps(value)}" for key, value in own.items()]
        return "\n".join(lines) + f"\n{INSECURE}"

    def __enter__(self) -> LoadedFleet:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self, name: str) -> None:
        """Start an agent, which ends with this thread."""
        self.running[name] = self.rig.agent(self._configs[name], ours=True)

    def file(self, agent: str, task: str) -> Path:
        """Return the file of a task's reports."""
        return self.directory / f"{agent}.{task}.jsonl"

    def told(self, agent: str, task: str, since_s: float = 0.0) -> list[dict[str, Any]]:
        """Return the reports of a task since a moment of the machine's clock."""
        path = self.file(agent, task)
        text = path.read_text() if path.exists() else ""
        rows = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
        return [row for row in rows if row["at_s"] >= since_s]

    def last(self, agent: str, task: str) -> dict[str, Any]:
        """Return the last report of a task."""
        return (self.told(agent, task) or [{}])[-1]

    def configure(self, agent: str, task: str, **settings: Any) -> None:
        """Change settings of a running task."""
        reply = self.client.request(agent, Configure(f"client/{task}", settings))
        assert reply.ok, reply.reason

    def memory_bytes(self, agent: str) -> int:
        """Return the resident memory of an agent."""
        for line in Path(f"/proc/{self.running[agent].pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024
        raise AssertionError(f"{agent} has no memory: it has ended")

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> float:
        """Wait until a condition holds; return how long it took, in seconds."""
        began_s = time.monotonic()
        while not condition():
            took_s = time.monotonic() - began_s
            assert took_s < timeout_s, f"{what}: not within {timeout_s:g} s"
            self.client.wait(lambda: False, 0.02)
        return time.monotonic() - began_s

    def close(self) -> None:
        """End all of them."""
        self.client.close()
        self.rig.close()
