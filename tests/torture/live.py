"""Real agents in processes of their own, whose tasks hold a lock while they run: an oracle outside of all agents."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path

from cli.processes import READY, Rig, Running

SOURCE = '''
import fcntl
import os
import time
from dataclasses import dataclass

from pancakes.devices.driver import Actuator
from pancakes.devices.types import Twist
from pancakes.task import Task, every


class Holder(Task):
    """Holds a lock while it runs and may act, and counts in a file that all agents share."""

    @dataclass
    class Settings:
        directory: str = ""

    @dataclass
    class State:
        n: int = 0

    def on_start(self):
        self.fence_n = self.fence.epoch[0]
        self.lock = os.open(self.file("lock"), os.O_CREAT | os.O_RDWR)
        self.count = os.open(self.file("count"), os.O_CREAT | os.O_WRONLY | os.O_APPEND)
        self.take()

    def on_stop(self):
        os.close(self.lock)
        os.close(self.count)

    def on_failure(self, exception_type, exception_value, traceback):
        self.say("doubled", f"failed: {exception_value!r}")
        self.on_stop()

    def pause(self):
        super().pause()
        fcntl.flock(self.lock, fcntl.LOCK_UN)

    def resume(self):
        self.take()
        super().resume()

    def take(self):
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.say("doubled", f"{self.address} epoch {self.fence_n} runs beside another")

    def file(self, kind):
        return os.path.join(self.settings.directory, f"{self.name}.{kind}")

    def say(self, kind, text):
        with open(self.file(kind), "a") as out:
            out.write(text + "\\n")

    @every(hz=50)
    def tick(self, tick):
        self.state.n += 1
        os.write(self.count, f"{self.state.n} {self.fence_n} {self.agent} {os.getpid()}\\n".encode())


class Pilot(Task):
    """Drives, a hundred times a second, and carries so much state."""

    requires = ("motors",)

    @dataclass
    class Settings:
        state_bytes: int = 1024

    @dataclass
    class State:
        n: int = 0
        load: bytes = b""

    def on_start(self):
        if len(self.state.load) != self.settings.state_bytes:
            self.state.load = os.urandom(self.settings.state_bytes)

    @every(hz=100)
    def drive(self, tick):
        self.state.n += 1
        self.publish("ctrl", Twist(0.1, 0.0))


class Recorder(Actuator):
    """Wheels that write down when they were commanded, on the clock that all processes of a machine share."""

    type = "motors"

    @dataclass
    class Settings:
        file: str = ""

    def open(self):
        self.out = os.open(self.settings.file, os.O_CREAT | os.O_WRONLY | os.O_APPEND)

    def close(self):
        os.close(self.out)

    def apply(self, command, ttl_s, source):
        os.write(self.out, f"{time.monotonic_ns()} {source}\\n".encode())

    def hold(self):
        pass
'''
ENTRY_POINTS = """
[pancakes.tasks]
torture.Holder = plugin_torture:Holder
torture.Pilot = plugin_torture:Pilot

[pancakes.drivers]
torture.recorder = plugin_torture:Recorder
"""


def free_ports(count: int) -> list[int]:
    """Returns ports of this machine that are free just now; they outlive a restart, which port 0 would not."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]
    finally:
        for one in sockets:
            one.close()


class LiveFleet:
    """Agents in processes, on this machine, that are killed and started again.

    Args:
        directory: all of their files.
        names: their names.
        rest: what follows `[agent]` in the configuration of each, by name.
        peers: where each dials the others, by name; not named: where they listen.

    Attributes:
        running: the processes that run, by name.
        addresses: where each listens.
    """

    def __init__(
        self,
        directory: Path,
        names: Sequence[str],
        rest: Mapping[str, str],
        addresses: Mapping[str, str] | None = None,
        peers: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.directory = directory
        self.rig = Rig(directory)
        self.rig.install("torture", ENTRY_POINTS, SOURCE)
        self.names = tuple(names)
        ports = free_ports(len(names))
        self.addresses = dict(
            addresses or {name: f"tcp://127.0.0.1:{port}" for name, port in zip(names, ports, strict=True)}
        )
        self.running: dict[str, Running] = {}
        self._configs: dict[str, Path] = {}
        for name in names:
            dialled = list((peers or {}).get(name, [self.addresses[other] for other in names if other != name]))
            head = f'schema = 1\n[agent]\nname = "{name}"\nfleet = "torture"\nlisten = "{self.addresses[name]}"\n'
            path = directory / f"{name}.toml"
            path.write_text(f"{head}peers = {json.dumps(dialled)}\n{rest.get(name, '')}\n")
            self._configs[name] = path

    def start(self, name: str, wait: bool = False) -> None:
        """Starts an agent, or starts it again with the state that it left."""
        self.running[name] = self.rig.agent(self._configs[name])
        if wait:
            self.running[name].hear(READY)

    def kill(self, name: str) -> None:
        """Kills an agent with SIGKILL; returns once it is dead."""
        running = self.running.pop(name, None)
        if running is not None:
            running.close()

    def close(self) -> None:
        """Ends all of them."""
        self.running.clear()
        self.rig.close()
