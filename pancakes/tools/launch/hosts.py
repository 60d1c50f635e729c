"""The hosts of a fleet: one connection to each, and what each is. All that cannot be reached are told at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pancakes.errors import PancakesError
from pancakes.tools.launch.host_link import OPEN_S, HostLink
from pancakes.tools.launch.member import Member


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
    is_: Mapping[str, Any]

    def agent(self, name: str) -> Mapping[str, Any]:
        """Returns what is there of an agent."""
        found: Mapping[str, Any] = self.is_["agents"][name]
        return found

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
            link.close()


def _looked(members: Sequence[Member], links: Mapping[str, HostLink]) -> dict[str, Host]:
    hosts, problems = {}, []
    for name, link in links.items():
        fleets = {it.name: it.config.agent.fleet for it in members if it.host == name}
        try:
            hosts[name] = Host(name, link, link.obtain("look", OPEN_S, fleet_of=fleets))
        except PancakesError as error:
            problems.append(str(error))
    if problems:
        raise PancakesError("\n".join(problems))
    return hosts
