"""What an agent's transports are told, from its configuration and the keys that this machine has for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import ConfigError, PancakesError
from pancakes.mesh.address import LOCAL, is_local
from pancakes.mesh.security.certified import fault_of_bearer
from pancakes.mesh.security.key_folders import keys_of_agent
from pancakes.runtime.config.tables import AgentConfig, Config
from pancakes.runtime.runtime_dir import make_directory, runtime_dir
from pancakes.runtime.services.network import NetworkService
from pancakes.settings import make_settings

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


def network_settings(config: Config) -> NetworkService.Settings:
    """Returns those settings of the network that are for transports and mesh, which are there before the service.

    Raises:
        SettingsError: they do not fit; a configuration that was made in code has not been checked before.
    """
    network = config.services.get("network")
    given = network.settings if network is not None else {}
    early = ("heartbeat_s", "busy_poll_s", "insecure", "keys", "transports")
    return make_settings(NetworkService.Settings, {key: given[key] for key in early if key in given})


def tcp_addresses(agent: AgentConfig) -> list[str]:
    """Returns the addresses of an agent's configuration that are reached over TCP."""
    return [address for address in (*agent.listen, *agent.peers) if address.startswith(f"{TCP}://")]


def addresses_of(agent: AgentConfig, network: NetworkService.Settings) -> tuple[tuple[str, ...], str]:
    """Returns where an agent listens, and why not at `local://`, where another user took the place of its directory."""
    directory = network.transports.get(LOCAL, {}).get("directory")
    try:
        if not agent.local_group and not any(is_local(address) for address in agent.listen):
            make_directory(Path(str(directory)) if directory else runtime_dir())
    except (OSError, PancakesError) as error:
        return agent.listen, str(error)
    return agent.addresses, ""


def keys_for(config: Config, network: NetworkService.Settings) -> Keys | None:
    """Returns an agent's keys; None: it has none, and is to do without.

    Raises:
        ConfigError: it is to speak over TCP, and has no keys for that, or none that are of use; the fault says what to
            do.
    """
    agent, places = config.agent, config.places
    folder = Path(network.keys) if network.keys else keys_of_agent(agent.fleet, agent.name)
    if folder is not None:
        try:
            return _keys_of(agent, folder)
        except PancakesError as error:
            key = ("service", "network", "settings", "keys") if network.keys else ("agent", "name")
            raise ConfigError([places.fault(key, str(error))]) from None
    addresses = tcp_addresses(agent)
    if addresses and not network.insecure:
        raise ConfigError(
            [
                places.fault(
                    ("agent", "listen" if addresses[0] in agent.listen else "peers"),
                    f"{addresses[0]!r} needs keys of the agent {agent.name} of the fleet {agent.fleet}: run pancakes"
                    f" fleet join, or use {LOCAL}://{agent.name} for this machine alone",
                )
            ]
        )
    return None


def _keys_of(agent: AgentConfig, folder: Path) -> Keys:
    from pancakes.mesh.security.keys import Keys  # and with it OpenSSL, for which an agent without keys has no use

    keys = Keys(folder)
    if fault := fault_of_bearer(keys.own, agent.name, agent.role, agent.fleet):
        raise PancakesError(f"the keys in {folder} are not those of this agent: {fault}. Run pancakes fleet join")
    return keys
