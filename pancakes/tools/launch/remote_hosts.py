"""Work with the hosts of a fleet: probe them, tunnel to their agents, and run agents of a launch on them.

`open_hosts` connects to all hosts at once and lists those that cannot be reached. A tunnel is a Unix socket that
OpenSSH forwards to the socket of an agent. The agent takes the connection for its own user's, and asks for no keys.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, TypedDict

from pancakes.errors import PancakesError, UnreachableError
from pancakes.mesh.address import LOCAL
from pancakes.tools.launch.fleet_file import Member
from pancakes.tools.launch.ssh import (
    OPEN_S,
    HostError,
    HostLink,
    no_ssh,
    scratch_file,
    sentence_of,
    silent,
    ssh_command,
    start_ssh,
)
from pancakes.tools.remote_host.agent_processes import AgentListener
from pancakes.util.clock import MonotonicClock


class HostService(TypedDict):
    """The service of an agent on a host."""

    manager: str
    state: str
    pid: int
    restarts: int


class HostedAgent(TypedDict):
    """What a host has of an agent. `pancakes.tools.remote_host.host_probe` documents this and the other answers."""

    keys: bool
    python: str
    socket: str
    version: str
    last: str
    config: str
    environment: str
    versions: dict[str, str]
    about: dict[str, Any]
    service: HostService | None


class HostEntry(TypedDict):
    """An agent that runs on a host."""

    name: str
    fleet: str
    role: str
    pid: int


class HostLook(TypedDict):
    """The answer of a host to a probe."""

    user: str
    python: list[int]
    executable: str
    platform: str
    libc: list[str]
    free_bytes: int
    data: str
    systemd: bool
    environments: list[str]
    libraries: list[str]
    running: list[HostEntry]
    agents: dict[str, HostedAgent]


@dataclass(frozen=True)
class Host:
    """One host.

    Attributes:
        name: the host, as `ssh` takes it.
        link: the connection.
        is_: its answer to the probe (`pancakes.tools.remote_host.host_probe`).
    """

    name: str
    link: HostLink
    is_: HostLook

    def agent(self, name: str) -> HostedAgent:
        """Return what the host has of an agent."""
        return self.is_["agents"][name]

    def runs(self, member: Member) -> int:
        """Return the process number of an agent on the host; 0: it does not run."""
        agent = member.config.agent
        entries = self.is_["running"]
        return next((it["pid"] for it in entries if (it["fleet"], it["name"]) == (agent.fleet, agent.name)), 0)


@contextmanager
def open_hosts(members: Sequence[Member], unreached: Callable[[str], None] | None = None) -> Iterator[dict[str, Host]]:
    """Connect to the hosts of agents, all at once, and disconnect at the end.

    Args:
        members: the agents.
        unreached: is called with a sentence for each host that cannot be reached, which is left out; None: an error.

    Yields:
        The hosts by name; empty if all agents run on this machine.

    Raises:
        PancakesError: hosts cannot be reached, or cannot run Pancakes; the sentences name all of them.
    """
    links: dict[str, HostLink] = {}
    try:
        for host in dict.fromkeys(member.host for member in members if member.host):
            links[host] = HostLink(host)
        hosts, problems = _looked(members, links)
        if unreached is None and problems:
            raise PancakesError("\n".join(problems))
        if unreached is not None:
            for problem in problems:
                unreached(problem)
        yield hosts
    finally:
        for link in links.values():
            link.let_go()
        for link in links.values():
            link.close()


def _looked(members: Sequence[Member], links: Mapping[str, HostLink]) -> tuple[dict[str, Host], list[str]]:
    """Return the hosts that can be reached, and a sentence for each other one."""
    hosts: dict[str, Host] = {}
    problems: list[str] = []

    def look(name: str) -> HostLook:
        fleets = {it.name: it.config.agent.fleet for it in members if it.host == name}
        found: HostLook = links[name].obtain("look", OPEN_S, HostLook, fleet_of=fleets)
        if missing := [agent for agent in fleets if agent not in found["agents"]]:
            raise HostError(f"{name} did not report on {', '.join(missing)}")
        return found

    # In parallel, so that several silent hosts cost one timeout and not one each.
    with ThreadPoolExecutor(max_workers=max(1, len(links))) as threads:
        looks = {name: threads.submit(look, name) for name in links}
    for name, looked in looks.items():
        try:
            hosts[name] = Host(name, links[name], looked.result())
        except PancakesError as error:
            problems.append(str(error))
    return hosts, problems


LOOK_S: Final = 0.05
END_S: Final = 2.0
"""How long a tunnel may take to end before it is killed, in seconds."""
_NOW: Final = MonotonicClock().now


@contextmanager
def tunnels(hosts: Iterable[Host]) -> Iterator[dict[str, str]]:
    """Open a tunnel to each agent of some hosts, whether it runs or not, and close them at the end. Blocks.

    Yields:
        The local address of each agent, by its name.

    Raises:
        PancakesError: a host cannot be reached, or does not allow tunnels.
    """
    folder = tempfile.mkdtemp(prefix="pancakes-tunnel-")
    addresses: dict[str, str] = {}
    opened: list[_Tunnel] = []
    try:
        for host in hosts:
            sockets = {}
            for name, agent in host.is_["agents"].items():
                path = Path(folder) / f"{len(addresses)}.sock"
                sockets[path] = agent["socket"]
                addresses[name] = f"{LOCAL}://{path}"
            opened.append(_Tunnel(host.name, sockets))
        until_s = _NOW() + OPEN_S
        for tunnel in opened:
            tunnel.wait(until_s)
        yield addresses
    finally:
        for tunnel in opened:
            tunnel.close()
        shutil.rmtree(folder, ignore_errors=True)


class _Tunnel:
    """The tunnels to the agents of one host: the remote socket for each local one."""

    def __init__(self, host: str, sockets: dict[Path, str]) -> None:
        self._host, self._sockets = host, sockets
        options = [word for local, remote in sockets.items() for word in ("-L", f"{local}:{remote}")]
        options += ["-o", "ExitOnForwardFailure=yes", "-o", "StreamLocalBindMask=0177"]
        self._errors = scratch_file()
        try:
            # The remote shell ends when its standard input closes, however this program ends.
            command = [*ssh_command(host, "-T", *options), "exec sh -c 'while read -r line; do :; done'"]
            self._process = start_ssh(command, subprocess.DEVNULL, self._errors)
        except OSError as error:
            os.close(self._errors)
            raise PancakesError(no_ssh(error)) from None

    def wait(self, until_s: float) -> None:
        while not all(path.exists() for path in self._sockets):
            code = self._process.poll()
            errors = os.pread(self._errors, 65_536, 0).decode("utf-8", "replace")
            if code is not None:
                raise UnreachableError(sentence_of(self._host, code, errors))
            if _NOW() > until_s:
                raise UnreachableError(silent(self._host, OPEN_S, errors))
            time.sleep(LOOK_S)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(OSError):
            os.close(self._errors)


ALIVE_S: Final = 5.0
"""How often a host is sent a sign of life, in seconds: without it, the host ends the agents."""
KILL_S: Final = 2.0
"""How long a host may take to report the end of a killed agent before its connection is closed, in seconds."""
LOST: Final = 255
"""The exit code of an agent whose connection is lost: the one that `ssh` uses."""


class LaunchListener(AgentListener, Protocol):
    """Receive the events of the agents of a launch, in the thread that runs it."""

    def started(self, name: str, pid: int, host: str = "") -> None:
        """Handle that an agent runs as process `pid` on `host`; empty: on this machine."""

    def failed(self, name: str, reason: str) -> None:
        """Handle that an agent could not be started; `reason` is a phrase."""


@dataclass(frozen=True)
class HostStart:
    """What a host needs to start an agent.

    Attributes:
        config: its configuration, as TOML.
        sets: the changes to it, as `--set` takes them.
        keys: the files of its keys for this run, in base64.
        fresh: whether its state directory is cleared before the first start.
    """

    config: str
    sets: tuple[str, ...]
    keys: Mapping[str, str]
    fresh: bool = False


class HostAgents:
    """Start and end agents on hosts.

    Args:
        members: the agents that have a host.
        starts: what each needs to start.
        links: the open connections by host; `close` closes them.
        selector: file descriptors are registered with it; the data of each is the callback to call.
        now: returns host time, in seconds.
    """

    def __init__(
        self,
        members: Sequence[Member],
        starts: Mapping[str, HostStart],
        links: Mapping[str, HostLink],
        selector: selectors.BaseSelector,
        now: Callable[[], float],
    ) -> None:
        self._members = {member.name: member for member in members}
        self._starts = dict(starts)
        self._links = dict(links)
        self._selector = selector
        self._now = now
        self._asked: dict[tuple[str, int], str] = {}
        self._run: set[str] = set()
        self._kill_s: dict[str, float] = {}
        self._alive_s = now() + ALIVE_S

    def attend(self, listener: LaunchListener) -> None:
        """Begin to listen to the hosts."""
        self._listener = listener
        for host in self._links:
            self._register(host)

    @property
    def due_s(self) -> float:
        """When `tick` is due."""
        return min([self._alive_s, *self._kill_s.values()])

    def start(self, name: str) -> None:
        """Start an agent; connect to its host again if that connection was lost."""
        member, start = self._members[name], self._starts[name]
        link = self._links.get(member.host)
        if link is None or link.lost:
            try:
                link = self._links[member.host] = HostLink(member.host)
            except PancakesError as error:
                self._listener.failed(name, str(error))
                return
            self._register(member.host)
        self._run.add(name)
        number = link.send(
            "start",
            fleet=member.config.agent.fleet,
            agent=name,
            config=start.config,
            sets=list(start.sets),
            keys=dict(start.keys),
            fresh=start.fresh,
        )
        self._asked[member.host, number] = name
        self._starts[name] = HostStart(start.config, start.sets, start.keys)
        self._watch_writes(link)

    def end(self, name: str) -> None:
        """Tell an agent to end."""
        self._order(name, "end")

    def kill(self, name: str) -> None:
        """End an agent by force."""
        self._kill_s[name] = self._now() + KILL_S
        self._order(name, "kill")

    def tick(self) -> None:
        """Do what is due: signs of life, and connections to give up."""
        now_s = self._now()
        if now_s >= self._alive_s:
            self._alive_s = now_s + ALIVE_S
            for host, link in self._links.items():
                handles = (link.reads, link.writes)
                if link.end_if_silent():
                    self._lost(host, handles)
                elif not link.lost:
                    link.send("alive")
                    self._watch_writes(link)
        for name, at_s in list(self._kill_s.items()):
            if now_s >= at_s:
                del self._kill_s[name]
                host = self._members[name].host
                if name in self._run and not self._links[host].lost:
                    self._lose(host, within_s=0.0)

    def close(self) -> None:
        """End all connections, and with them all agents."""
        for link in self._links.values():
            link.close()

    def _order(self, name: str, word: str) -> None:
        link = self._links[self._members[name].host]
        if not link.lost:
            link.send(word, agent=name)
            self._watch_writes(link)

    def _register(self, host: str) -> None:
        link = self._links[host]
        self._selector.register(link.reads, selectors.EVENT_READ, lambda: self._read(host))
        self._watch_writes(link)

    def _watch_writes(self, link: HostLink) -> None:
        """Wait for the connection to be writable while it has requests to send."""
        registered = link.writes in self._selector.get_map()
        if link.has_more and not registered:
            self._selector.register(link.writes, selectors.EVENT_WRITE, lambda: self._write(link))
        elif registered and not link.has_more:
            self._selector.unregister(link.writes)

    def _write(self, link: HostLink) -> None:
        link.flush()
        self._watch_writes(link)

    def _read(self, host: str) -> None:
        link = self._links[host]
        handles = (link.reads, link.writes)
        messages = link.read()
        if link.lost:
            self._lost(host, handles)
            return
        self._watch_writes(link)
        for message in messages:
            self._take(host, message)

    def _lose(self, host: str, within_s: float) -> None:
        link = self._links[host]
        handles = (link.reads, link.writes)
        link.close(within_s)
        self._lost(host, handles)

    def _lost(self, host: str, handles: Sequence[int]) -> None:
        for handle in handles:
            if handle in self._selector.get_map():
                self._selector.unregister(handle)
        self._asked = {key: name for key, name in self._asked.items() if key[0] != host}
        for name in [name for name in self._run if self._members[name].host == host]:
            self._run.discard(name)
            self._listener.ended(name, LOST, self._links[host].lost)

    def _take(self, host: str, message: dict[str, Any]) -> None:
        name = message.get("agent") or self._asked.pop((host, message.get("id", 0)), "")
        if name not in self._run:
            return
        if "fault" in message:
            self._run.discard(name)
            self._listener.failed(name, f"{host} {message['fault']}")
        elif "result" in message:
            result = message["result"]
            pid = result.get("pid") if isinstance(result, dict) else None
            self._listener.started(name, pid if isinstance(pid, int) else 0, host)
        elif message.get("event") == "line":
            self._listener.printed(name, message.get("text", ""))
        elif message.get("event") == "said":
            self._listener.said(name, message.get("text", ""))
        elif message.get("event") == "ended":
            self._run.discard(name)
            self._kill_s.pop(name, None)
            self._listener.ended(name, message.get("code", LOST))
