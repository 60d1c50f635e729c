"""What an agent's transports are told, from its configuration and the keys that this machine has for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.address import LOCAL
from pancakes.mesh.security.certified import fault_of_bearer
from pancakes.mesh.security.key_folders import keys_of_agent
from pancakes.runtime.config.tables import AgentConfig
from pancakes.runtime.services.network import NetworkService

TCP: Final = "tcp"

TransportSettings = Mapping[str, Mapping[str, Any]]
"""The settings of transports, by the scheme of their addresses."""


def transport_settings(agent: AgentConfig, network: NetworkService.Settings) -> TransportSettings:
    """Returns the settings of an agent's transports.

    Raises:
        PancakesError: it is to speak over TCP, and has no keys for that, or another's; the sentence says what to do.
    """
    tcp = {**network.transports.get(TCP, {}), "insecure": network.insecure}
    folder = Path(str(tcp["keys"])) if tcp.get("keys") else keys_of_agent(agent.fleet, agent.name)
    addresses = tcp_addresses(agent)
    if folder is not None:
        tcp["keys"] = str(folder)
        if addresses:
            _check_bearer(agent, folder)
    elif addresses and not network.insecure:
        raise PancakesError(
            f"{addresses[0]!r} needs keys of the agent {agent.name} of the fleet {agent.fleet}: run pancakes fleet"
            f" join, or use {LOCAL}://{agent.name} for this machine alone"
        )
    group = {"group": agent.local_group} if agent.local_group else {}
    return {**network.transports, TCP: tcp, LOCAL: {**network.transports.get(LOCAL, {}), **group}}


def tcp_addresses(agent: AgentConfig) -> list[str]:
    """Returns the addresses of an agent's configuration that are reached over TCP."""
    return [address for address in (*agent.listen, *agent.peers) if address.startswith(f"{TCP}://")]


def _check_bearer(agent: AgentConfig, folder: Path) -> None:
    from pancakes.mesh.security.keys import Keys  # and with it OpenSSL, for which an agent without keys has no use

    if fault := fault_of_bearer(Keys(folder).own, agent.name, agent.role, agent.fleet):
        raise PancakesError(f"the keys in {folder} are not those of this agent: {fault}. Run pancakes fleet join")
