"""Run agents as processes of this machine, and follow their logs."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from keys_in_test import KeysInTest

from pancakes.client import Client, Target
from pancakes.tools.launch.process import ForkedProcess, ForkServer

CONNECTED: Final = " is connected"
SWEPT: Final = "/client/Sweeper: soak_swept pieces="
ENDED: Final = "the link to "
LOOK_S: Final = 0.02
"""How often the logs are read during a wait, in seconds."""
PATIENCE_S: Final = 30.0
ENTRY_POINTS: Final = """
[pancakes.tasks]
soak.Listener = soak.tasks:Listener
soak.Passing = soak.tasks:Passing
soak.Sweeper = soak.tasks:Sweeper
soak.Talker = soak.tasks:Talker
soak.Worker = soak.tasks:Worker

[pancakes.packets]
soak = soak.tasks
"""


class NotInTimeError(Exception):
    """Something did not happen in time; the sentence says what."""


class AgentProcess:
    """One agent, which may be killed and started again, and the state that its log shows.

    Attributes:
        name: its name.
        address: its address, the same in all runs.
        process: its process; None while it is dead.
        is_ready: whether its log says that it is ready.
        links: the agents that it is connected to.
        ended: peer and reason of each ended link, of all runs.
        pieces: how many memory blocks were in use at its last garbage collection; 0: none in this run.
        log: its log file, of all runs.
    """

    def __init__(self, name: str, address: str, config: Path, log: Path) -> None:
        self.name = name
        self.address = address
        self.log = log
        self.process: ForkedProcess | None = None
        self.is_ready = False
        self.links: set[str] = set()
        self.ended: list[tuple[str, str]] = []
        self.pieces = 0
        self._config = config
        self._file: int | None = None
        self._rest = b""

    def start(self, server: ForkServer) -> None:
        """Start the agent, or start it again with its former state. It ends with this process."""
        self.is_ready, self.links, self.pieces = False, set(), 0
        with self.log.open("ab") as out:
            if self._file is None:
                self._file = os.open(self.log, os.O_RDONLY)
            arguments = ["--config", str(self._config), f"--die-with-parent={os.getpid()}"]
            self.process = server.fork(arguments, out.fileno(), None)

    def end(self, kill: bool) -> None:
        """Stop the agent, with SIGKILL or gracefully, and wait for its end; it may be dead already."""
        if self.process is None:
            return
        if kill:
            self.process.kill()
        else:
            self.process.terminate()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.read()
        self.process, self.links, self.is_ready = None, set(), False

    def close(self) -> None:
        """Kill the agent, and close its log."""
        self.end(kill=True)
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def read(self) -> None:
        """Read the new lines of the log."""
        if self._file is None:
            return
        while data := os.read(self._file, 1 << 16):
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                self._take(line.decode(errors="replace"))

    def _take(self, line: str) -> None:
        _, _, pieces = line.partition(f"{self.name}{SWEPT}")
        if pieces:
            self.pieces = int(pieces)
            return
        _, _, text = line.partition(f"{self.name}/kernel: ")
        if not text:
            return
        if text == "ready":
            self.is_ready = True
        elif text.endswith(CONNECTED):
            self.links.add(text.partition(" ")[0])
        elif text.startswith(ENDED):
            peer, _, reason = text.removeprefix(ENDED).partition(" has ended: ")
            self.links.discard(peer)
            self.ended.append((peer, reason))


class Fleet:
    """Agents that find each other: the configuration of each names only the first ones as peers.

    The agents have keys. Inside the context, clients of this process have keys, too.

    Args:
        directory: the folder for all files.
        names: their names.
        rest: the part after `[agent]` of each configuration, by name.
        peers: how many agents, the first ones, each configuration names as peers.
        addresses: the address of each agent, by name; None: free ports of this machine.

    Attributes:
        agents: the agents, by name.
        environment: the environment of their processes; it is read when the first one starts.
    """

    def __init__(
        self,
        directory: Path,
        names: Sequence[str],
        rest: Mapping[str, str],
        peers: int = 1,
        addresses: Mapping[str, str] | None = None,
    ) -> None:
        self.directory = directory
        keys = KeysInTest(directory)
        self.environment = {**_offer_tasks(directory), **keys.environment}
        self._offered = keys.offered()
        self._server = ForkServer(self.environment)
        self.agents: dict[str, AgentProcess] = {}
        addresses = addresses or dict(zip(names, free_addresses(len(names)), strict=True))
        for name in names:
            known = [addresses[other] for other in names[:peers] if other != name]
            head = f'schema = 1\n[agent]\nname = "{name}"\nfleet = "soak"\nlisten = "{addresses[name]}"\n'
            head += f'state_dir = "{self.state_of(name)}"\npeers = {json.dumps(known)}\n'
            path = directory / f"{name}.toml"
            path.write_text(f"{head}\n{rest.get(name, '')}\n")
            keys.of_agent("soak", name)
            self.agents[name] = AgentProcess(name, addresses[name], path, directory / f"{name}.log")

    def __enter__(self) -> Fleet:
        self._offered.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        with ExitStack() as stack:
            stack.push(self._offered)
            stack.callback(self._server.close)
            for agent in self.agents.values():
                stack.callback(agent.close)

    def state_of(self, name: str) -> Path:
        """Return the state directory of an agent."""
        return self.directory / "state" / name

    def start(self, *names: str) -> None:
        """Start the named agents at once; without names, all agents."""
        for name in names or self.agents:
            self.agents[name].start(self._server)

    def read(self) -> None:
        """Read all logs."""
        for agent in self.agents.values():
            agent.read()

    def until(self, condition: Callable[[], bool], what: str, within_s: float = PATIENCE_S) -> float:
        """Wait until a condition on the logs holds; return how long it took, in seconds.

        Raises:
            NotInTimeError: it does not hold within `within_s` seconds, or an agent has ended by itself.
        """
        began_s = time.monotonic()
        while True:
            self.read()
            if condition():
                return time.monotonic() - began_s
            if self.dead():
                raise NotInTimeError(
                    f"{what}: {', '.join(self.dead())} ended by itself; {self.last_words(self.dead()[0])}"
                )
            if time.monotonic() - began_s > within_s:
                ended = "; ".join(f"{agent} lost {peer}: {reason}" for agent, peer, reason in self.ended_links())
                raise NotInTimeError(
                    f"{what}: not within {within_s:g} s; {self.missing()}; {ended or 'no link has ended'}"
                )
            time.sleep(LOOK_S)

    def alive(self) -> list[AgentProcess]:
        """Return the agents that were started and not ended."""
        return [agent for agent in self.agents.values() if agent.process is not None]

    def dead(self) -> list[str]:
        """Return the agents that have ended by themselves."""
        return [agent.name for agent in self.alive() if agent.process is not None and agent.process.poll() is not None]

    def all_ready(self) -> bool:
        """Return whether all running agents are ready."""
        return all(agent.is_ready for agent in self.alive())

    def is_full_mesh(self) -> bool:
        """Return whether all running agents are connected with each other."""
        names = {agent.name for agent in self.alive()}
        return all(names - {agent.name} <= agent.links for agent in self.alive())

    def missing(self) -> str:
        """Return a sentence about the missing links."""
        names = {agent.name for agent in self.alive()}
        gaps = [
            f"{agent.name}-{other}" for agent in self.alive() for other in sorted(names - agent.links - {agent.name})
        ]
        return f"{len(gaps)} links are missing: {', '.join(gaps[:10])}" if gaps else "no link is missing"

    def ended_links(self) -> Iterator[tuple[str, str, str]]:
        """Yield the links that have ended so far: the agent that reports it, its peer, the reason."""
        for agent in self.agents.values():
            for peer, reason in agent.ended:
                yield agent.name, peer, reason

    def last_words(self, name: str, count: int = 5) -> str:
        """Return the last lines of an agent's log."""
        lines = self.agents[name].log.read_text(errors="replace").splitlines()
        return " | ".join(line.strip() for line in lines[-count:])


def bytes_sent(fleet: Fleet) -> tuple[int, float]:
    """Ask all agents how many bytes they have sent to other agents so far.

    Returns:
        The sum, without the headers of TCP and IP, and the time of the question.
    """
    with Client(Target(tuple(agent.address for agent in fleet.alive()), "soak"), PATIENCE_S) as client:
        rows = client.describe().agents
        peers = [peer for row in rows for peer in row["mesh"]["peers"] if peer["role"] != "client"]
        return sum(peer["bytes_out"] for peer in peers), time.monotonic()


def names_of(count: int) -> list[str]:
    """Return the names of `count` agents."""
    return [f"a{number:03d}" for number in range(count)]


def free_addresses(count: int) -> list[str]:
    """Return free addresses of this machine. Unlike port 0, they stay the same over a restart."""
    with ExitStack() as stack:
        found = []
        for _ in range(count):
            one = stack.enter_context(socket.socket())
            one.bind(("127.0.0.1", 0))
            found.append(f"tcp://127.0.0.1:{one.getsockname()[1]}")
        return found


def _offer_tasks(directory: Path) -> dict[str, str]:
    """Make a distribution with the tasks; return the environment in which agents find it."""
    info = directory / "python" / "pancakes_soak-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pancakes-soak\nVersion: 1\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    runtime = directory / "run"
    runtime.mkdir(mode=0o700)
    path = [str(info.parent), str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    return {
        # Python keeps its compiled files, as for a user; otherwise fifty starts at once would take longer.
        **{key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"},
        "PYTHONPATH": os.pathsep.join(part for part in path if part),
        "PANCAKES_RUNTIME_DIR": str(runtime),
    }
