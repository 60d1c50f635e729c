"""The hosts of a fleet: one connection to each, and what each is. All that cannot be reached are told at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypedDict

from pancakes.errors import PancakesError
from pancakes.tools.launch.host_link import OPEN_S, HostError, HostLink
from pancakes.tools.launch.member import Member


class HostService(TypedDict):
    """The service of an agent on a host."""

    manager: str
    state: str
    pid: int
    restarts: int


class HostedAgent(TypedDict):
    """What is on a host of an agent; see `pancakes.tools.there.looking`, as for the others."""

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
    """What a host says of itself."""

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
        is_: what it is (`pancakes.tools.there.looking`).
    """

    name: str
    link: HostLink
    is_: HostLook

    def agent(self, name: str) -> HostedAgent:
        """Returns what is there of an agent."""
        return self.is_["agents"][name]

    def runs(self, member: Member) -> int:
        """Returns the process of an agent there; 0: it does not run."""
        agent = member.config.agent
        entries = self.is_["running"]
        return next((it["pid"] for it in entries if (it["fleet"], it["name"]) == (agent.fleet, agent.name)), 0)


@contextmanager
def open_hosts(members: Sequence[Member]) -> Iterator[dict[str, Host]]:
    """Reaches the hosts of agents, all at once, and lets them go at the end.

    Yields:
        The hosts by name; none where all agents run on this machine.

    Raises:
        PancakesError: a host cannot be reached, or cannot run Pancakes; the sentences name all of these.
    """
    links: dict[str, HostLink] = {}
    try:
        for host in dict.fromkeys(member.host for member in members if member.host):
            links[host] = HostLink(host)
        yield _looked(members, links)
    finally:
        for link in links.values():
            link.let_go()
        for link in links.values():
            link.close()


def _looked(members: Sequence[Member], links: Mapping[str, HostLink]) -> dict[str, Host]:
    hosts, problems = {}, []

    def look(name: str) -> HostLook:
        fleets = {it.name: it.config.agent.fleet for it in members if it.host == name}
        found: HostLook = links[name].obtain("look", OPEN_S, HostLook, fleet_of=fleets)
        if missing := [agent for agent in fleets if agent not in found["agents"]]:
            raise HostError(f"{name} says nothing of {', '.join(missing)}")
        return found

    # Side by side: hosts that say nothing take their time once, and not one after the other.
    with ThreadPoolExecutor(max_workers=max(1, len(links))) as threads:
        looks = {name: threads.submit(look, name) for name in links}
    for name, looked in looks.items():
        try:
            hosts[name] = Host(name, links[name], looked.result())
        except PancakesError as error:
            problems.append(str(error))
    if problems:
        raise PancakesError("\n".join(problems))
    return hosts
