"""Keys for agents on hosts that have none yet: given out by the authority of their fleet, and sent over SSH."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from pancakes.errors import PancakesError
from pancakes.mesh.security.certified import CertifiedRole
from pancakes.mesh.security.key_files import FLEET, KEY, ROSTER
from pancakes.runtime.plugins import Plugins
from pancakes.runtime.transport_settings import keyed_addresses
from pancakes.tools.launch.hosts import Host
from pancakes.tools.launch.member import Member

if TYPE_CHECKING:
    from pancakes.mesh.security.fleet_office import FleetOffice

Need = Literal["has", "needs", "none"]


def keys_needed(members: Sequence[Member], hosts: Mapping[str, Host]) -> dict[str, Need]:
    """Returns which agents have keys on their hosts, which need some, and which need none, by name."""
    plugins = Plugins()
    found: dict[str, Need] = {}
    for member in members:
        network = member.config.services.get("network")
        settings = network.settings if network is not None else {}
        if hosts[member.host].agent(member.name)["keys"] or settings.get("keys"):
            found[member.name] = "has"
        else:
            needs = bool(keyed_addresses(member.config.agent, plugins)) and not settings.get("insecure")
            found[member.name] = "needs" if needs else "none"
    return found


def check_keys(members: Sequence[Member], needed: Mapping[str, Need]) -> None:
    """Sees to it that no agent lacks keys.

    Raises:
        PancakesError: some do; the sentences say which, and what to do.
    """
    problems = [
        f"{it.name} needs keys of the fleet {it.config.agent.fleet}, and {it.host} has none: pancakes deploy --enrol"
        " gives them out, or pancakes fleet join there"
        for it in members
        if needed[it.name] == "needs"
    ]
    if problems:
        raise PancakesError("\n".join([*problems, "nothing was brought to a host"]))


def enrol(
    members: Sequence[Member],
    needed: Mapping[str, Need],
    hosts: Mapping[str, Host],
    offices: Mapping[str, FleetOffice],
    tell: Callable[[str, str], None],
) -> None:
    """Gives keys to the agents that need some.

    Args:
        members: the agents.
        needed: see `keys_needed`.
        hosts: their hosts.
        offices: the authorities of their fleets, by fleet.
        tell: takes a clause about an agent, to be read after its name.

    Raises:
        PancakesError: a host does not take them.
    """
    for member in members:
        if needed[member.name] != "needs":
            continue
        agent = member.config.agent
        office = offices[agent.fleet]
        role: CertifiedRole = "environment" if agent.role == "environment" else "agent"
        before = [it for it in office.entries if not it.revoked and it.who == f"{role}/{agent.name}"]
        files = office.enrol_with_key(role, agent.name, before[-1].groups if before else ())
        sent = {ROSTER: files.roster, FLEET: files.authority, KEY: files.certificate + files.key}
        told = {name: b64encode(data).decode() for name, data in sent.items()}
        hosts[member.host].link.obtain("put_keys", fleet=agent.fleet, name=agent.name, files=told)
        again = ", beside the one that it was given before" if before else ""
        tell(member.name, f"has keys of the fleet {agent.fleet} on {member.host}, with a new certificate{again}")
