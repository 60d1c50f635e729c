"""What an agent's transports are told, from its configuration and the keys that this machine has for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.address import LOCAL
from pancakes.mesh.security.certified import fault_of_bearer
from pancakes.mesh.security.key_folders import keys_of_agent
from pancakes.runtime.config.tables import AgentConfig
from pancakes.runtime.services.network import NetworkService

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys

TCP: Final = "tcp"


def transport_settings(agent: AgentConfig, network: NetworkService.Settings) -> dict[str, Mapping[str, Any]]:
    """Returns the settings of an agent's transports, by the scheme of their addresses."""
    group = {"group": agent.local_group} if agent.local_group else {}
    return {
        **network.transports,
        TCP: {**network.transports.get(TCP, {}), "insecure": network.insecure},
        LOCAL: {**network.transports.get(LOCAL, {}), **group},
    }


def tcp_addresses(agent: AgentConfig) -> list[str]:
    """Returns the addresses of an agent's configuration that are reached over TCP."""
    return [address for address in (*agent.listen, *agent.peers) if address.startswith(f"{TCP}://")]


def keys_for(agent: AgentConfig, network: NetworkService.Settings) -> Keys | None:
    """Returns an agent's keys; None: it has none, and is to do without.

    Raises:
        PancakesError: it is to speak over TCP, and has no keys for that, or another's; the sentence says what to do.
    """
    folder = Path(network.keys) if network.keys else keys_of_agent(agent.fleet, agent.name)
    if folder is not None:
        from pancakes.mesh.security.keys import Keys  # and with it OpenSSL, for which an agent without keys has no use

        keys = Keys(folder)
        if fault := fault_of_bearer(keys.own, agent.name, agent.role, agent.fleet):
            raise PancakesError(f"the keys in {folder} are not those of this agent: {fault}. Run pancakes fleet join")
        return keys
    addresses = tcp_addresses(agent)
    if addresses and not network.insecure:
        raise PancakesError(
            f"{addresses[0]!r} needs keys of the agent {agent.name} of the fleet {agent.fleet}: run pancakes fleet"
            f" join, or use {LOCAL}://{agent.name} for this machine alone"
        )
    return None
