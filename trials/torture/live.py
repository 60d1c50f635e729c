"""Real agents in processes, whose tasks hold a file lock while they run: an oracle outside of all agents."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from cli.processes import INSECURE, READY, Rig, Running

SOURCE = '''
import fcntl
import os
import time
from dataclasses import dataclass

from pancakes.devices.driver import Actuator
from pancakes.devices import Twist
from pancakes.errors import MailboxFullError
from pancakes.packet import packet_type
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, every, on, reliable


@packet_type("torture.count")
@dataclass
class Count:
    """A packet of a stream, numbered by its sender."""

    n: int


class Holder(TaskCore, Task):
    """Holds a lock while it runs and may act, and counts its ticks in a file that all agents share."""

    __module__ = "pancakes"  # its names are Pancakes' own

    @dataclass
    class Settings:
        directory: str = ""
        ballast_bytes: int = 0

    @dataclass
    class State:
        n: int = 0
        heard: int = 0
        ballast: bytes = b""

    def on_start(self):
        self.gate("start")
        self.state.ballast = bytes(self.settings.ballast_bytes)
        self.fence_n = self._actor.fence.epoch[0]
        self.lock = os.open(self.file("lock"), os.O_CREAT | os.O_RDWR)
        self.count = os.open(self.file("count"), os.O_CREAT | os.O_WRONLY | os.O_APPEND)
        self.take()

    def on_stop(self):
        os.close(self.lock)
        os.close(self.count)

    def on_failure(self, exception_type, exception_value, traceback):
        self.say("doubled", f"failed: {exception_value!r}")
        self.on_stop()

    def freeze(self):
        super().freeze()
        fcntl.flock(self.lock, fcntl.LOCK_UN)

    def thaw(self):
        self.gate("resume")
        self.take()
        super().thaw()

    def take(self):
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.say("doubled", f"{self.address} epoch {self.fence_n} runs beside another")

    def gate(self, kind):
        """Block if a test has put a pipe in the way, until the test kills the agent or removes the pipe."""
        try:
            pipe = os.open(self.file(f"{kind}-{self.agent}"), os.O_WRONLY)
        except FileNotFoundError:
            return
        try:
            os.write(pipe, bytes(8192))
        except BrokenPipeError:
            pass
        os.close(pipe)

    def file(self, kind):
        return os.path.join(self.settings.directory, f"{self.name}.{kind}")

    def say(self, kind, text):
        with open(self.file(kind), "a") as out:
            out.write(text + "\\n")

    @every(hz=50)
    def tick(self, tick):
        self.state.n += 1
        os.write(self.count, f"{self.state.n} {self.fence_n} {self.agent} {os.getpid()}\\n".encode())

    @on("system", Count, queue=reliable(256))
    def hear(self, packet):
        self.say("heard", f"{packet.body.n} {self.state.heard}")
        self.state.heard = packet.body.n


class Teller(Task):
    """Sends a stream of numbered packets to each of some tasks, on any agent."""

    @dataclass
    class Settings:
        directory: str = ""
        to: tuple[str, ...] = ()

    def on_start(self):
        self.told = dict.fromkeys(self.settings.to, 0)

    @every(hz=20)
    def tell(self, tick):
        for task, n in self.told.items():
            try:
                self.publish("system", Count(n + 1), to=f"task:{task}")
            except MailboxFullError:
                continue  # too many packets wait: this one is not sent, so not counted
            self.told[task] = n + 1
            with open(os.path.join(self.settings.directory, f"{task.split('/')[1]}.told"), "w") as out:
                out.write(str(n + 1))


class Sentry(Task):
    """Counts in a file that all agents share, and drives; logs the numbers of the packets that it gets."""

    requires = ("motors",)

    @dataclass
    class Settings:
        directory: str = ""

    @dataclass
    class State:
        n: int = 0
        heard: int = 0

    def on_start(self):
        self.fence_n = self._actor.fence.epoch[0]
        self.count = self.opened("count")
        self.ears = self.opened("heard")

    def on_stop(self):
        os.close(self.count)
        os.close(self.ears)

    def opened(self, kind):
        path = os.path.join(self.settings.directory, f"{self.name}.{kind}")
        return os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND)

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        os.write(self.count, f"{self.state.n} {self.fence_n} {self.agent} {time.monotonic_ns()}\\n".encode())
        self.publish("ctrl", Twist(float(self.fence_n), float(self.state.n)))

    @on("system", Count, queue=reliable(256))
    def hear(self, packet):
        os.write(self.ears, f"{packet.body.n} {self.state.heard}\\n".encode())
        self.state.heard = packet.body.n


class Pilot(Task):
    """Drives a hundred times a second, with a state of `state_bytes`."""

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
    """Wheels that log the times of their commands, on the clock that all processes of a machine share."""

    type = "motors"

    @dataclass
    class Settings:
        file: str = ""

    def open(self):
        self.out = os.open(self.settings.file, os.O_CREAT | os.O_WRONLY | os.O_APPEND)

    def close(self):
        os.close(self.out)

    def write(self, command, ttl_s, source):
        os.write(self.out, f"{time.monotonic_ns()} {source}\\n".encode())

    def safe_stop(self):
        pass


class Tracer(Recorder):
    """Wheels that log the commands of a `Sentry`: its count and its epoch, the agent, and the time."""

    def write(self, command, ttl_s, source):
        count, epoch = int(command.omega_radps), int(command.v_mps)
        os.write(self.out, f"{count} {epoch} {self.context.agent} {time.monotonic_ns()}\\n".encode())
'''
ENTRY_POINTS = """
[pancakes.tasks]
torture.Holder = plugin_torture:Holder
torture.Pilot = plugin_torture:Pilot
torture.Sentry = plugin_torture:Sentry
torture.Teller = plugin_torture:Teller

[pancakes.packets]
torture = plugin_torture

[pancakes.drivers]
torture.recorder = plugin_torture:Recorder
torture.tracer = plugin_torture:Tracer
"""


LOWEST_PORT, LOWEST_LENT_PORT = 15_000, 32_000
"""Ports that the system does not give to outgoing connections, so they stay free while their agent is dead."""


def free_ports(count: int) -> list[int]:
    """Return free ports of this machine. Unlike port 0, they stay the same over a restart."""
    found: list[int] = []
    for port in random.SystemRandom().sample(range(LOWEST_PORT, LOWEST_LENT_PORT), LOWEST_LENT_PORT - LOWEST_PORT):
        with socket.socket() as one, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", port))
            found.append(port)
        if len(found) == count:
            break
    return found


class LiveFleet:
    """Agents in processes of this machine that are killed and started again.

    They have no keys, so that a proxy between them can read their packets.

    Args:
        directory: the folder for all files.
        names: their names.
        rest: the part after `[agent]` of each configuration, by name.
        addresses: the address of each, by name; None: free ports of this machine.
        peers: the addresses at which each dials the others, by name; without an entry: their own.
        commands: the prefix of the command of each, by name, for instance to run it in a namespace.
        roles: the role of each agent whose role is not `agent`, by name.
        network: the network settings of each, by name; without an entry: no keys.
        spoilt_by: Python that each agent runs at its start, such as what breaks it, to see whether that is noticed.

    Attributes:
        running: the processes that run, by name.
        addresses: where each listens.
        state: the directory that holds the state directory of each, by its name.
    """

    def __init__(
        self,
        directory: Path,
        names: Sequence[str],
        rest: Mapping[str, str],
        addresses: Mapping[str, str] | None = None,
        peers: Mapping[str, Sequence[str]] | None = None,
        commands: Mapping[str, Sequence[str]] | None = None,
        roles: Mapping[str, str] | None = None,
        network: Mapping[str, str] | None = None,
        spoilt_by: str = "",
    ) -> None:
        self.directory = directory
        self.state = directory / "state"
        self.rig = Rig(directory)
        self.rig.install("torture", ENTRY_POINTS, f"{SOURCE}\n{spoilt_by}")
        self.names = tuple(names)
        ports = free_ports(len(names))
        self.addresses = dict(
            addresses or {name: f"tcp://127.0.0.1:{port}" for name, port in zip(names, ports, strict=True)}
        )
        self.running: dict[str, Running] = {}
        self._commands = dict(commands or {})
        self._network = dict(network or {})
        self._configs: dict[str, Path] = {}
        self._heads: dict[str, str] = {}
        for name in names:
            dialled = list((peers or {}).get(name, [self.addresses[other] for other in names if other != name]))
            head = f'schema = 1\n[agent]\nname = "{name}"\nfleet = "torture"\nlisten = "{self.addresses[name]}"\n'
            head += f'state_dir = "{self.state / name}"\nrole = "{(roles or {}).get(name, "agent")}"\n'
            self._heads[name] = f"{head}peers = {json.dumps(dialled)}\n"
            self.configure(name, rest.get(name, ""))

    def configure(self, name: str, rest: str) -> None:
        """Change the part after `[agent]` of a configuration; it is used from the agent's next start."""
        path = self._configs[name] = self.directory / f"{name}.toml"
        path.write_text(f"{self._heads[name]}{rest}\n{self._network.get(name, INSECURE)}")

    def start(self, name: str, wait: bool = False) -> None:
        """Start an agent, or start it again with its former state. It ends with this thread."""
        command = [*self._commands.get(name, ()), sys.executable, "-m", "pancakes.tools.cli.agent_command"]
        command += ["--config", str(self._configs[name])]
        self.running[name] = Running(command, self.rig.environment, self.directory, ours=True)
        if wait:
            self.running[name].hear(READY)

    def strike(self, name: str) -> None:
        """Kill an agent with SIGKILL, without waiting for its end. Any thread; call `kill` afterwards."""
        running = self.running.get(name)
        if running is not None:
            running.process.kill()

    def kill(self, name: str) -> None:
        """Kill an agent with SIGKILL; return once it is dead."""
        running = self.running.pop(name, None)
        if running is not None:
            running.close()

    def close(self) -> None:
        """End all of them."""
        for name in list(self.running):
            self.kill(name)
