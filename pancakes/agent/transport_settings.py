"""The settings and keys of an agent's transports, from its configuration and the key folders of this machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.config.tables import AgentConfig, Config
from pancakes.errors import ConfigError, PancakesError
from pancakes.mesh.address import LOCAL, is_local
from pancakes.mesh.transport import facts_of
from pancakes.security.key_store import keys_of_agent
from pancakes.security.roster import fault_of_bearer
from pancakes.services.network import NetworkService
from pancakes.settings import make_settings
from pancakes.util.plugins import Plugins
from pancakes.util.runtime_dir import make_directory, runtime_dir

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


TCP: Final = "tcp"


def transport_settings(agent: AgentConfig, network: NetworkService.Settings) -> dict[str, Mapping[str, Any]]:
    """Return the settings of an agent's transports, by the scheme of their addresses."""
    if not agent.local_group:
        return dict(network.transports)
    return {**network.transports, LOCAL: {**network.transports.get(LOCAL, {}), "group": agent.local_group}}


def network_settings(config: Config) -> NetworkService.Settings:
    """Return the network settings that transports and mesh need before the Network Service exists.

    Raises:
        SettingsError: they do not fit; a configuration made in code was not checked before.
    """
    network = config.services.get("network")
    given = network.settings if network is not None else {}
    early = ("heartbeat_s", "busy_poll_s", "insecure", "keys", "transports")
    return make_settings(NetworkService.Settings, {key: given[key] for key in early if key in given})


def keyed_addresses(agent: AgentConfig, plugins: Plugins) -> list[str]:
    """Return the addresses of an agent's configuration whose transport encrypts if there are keys."""
    return [it for it in (*agent.listen, *agent.peers) if facts_of(it, True, plugins).encrypted]


def insecure_over(agent: AgentConfig, keyed: bool, plugins: Plugins) -> str:
    """Return the schemes that an agent uses without the keys that they need, such as `tcp://`; empty: none."""
    schemes = {it.partition("://")[0] for it in keyed_addresses(agent, plugins)}
    return "" if keyed else " and ".join(f"{scheme}://" for scheme in sorted(schemes))


def addresses_of(agent: AgentConfig, network: NetworkService.Settings) -> tuple[tuple[str, ...], str]:
    """Return where an agent listens, and why not at `local://`: another user took the place of its directory."""
    directory = network.transports.get(LOCAL, {}).get("directory")
    try:
        if not agent.local_group and not any(is_local(address) for address in agent.listen):
            make_directory(Path(str(directory)) if directory else runtime_dir())
    except (OSError, PancakesError) as error:
        return agent.listen, str(error)
    return agent.addresses, ""


def keys_for(config: Config, network: NetworkService.Settings, plugins: Plugins) -> Keys | None:
    """Return an agent's keys; None: it works without keys.

    Raises:
        ConfigError: it must speak to other machines, and has no usable keys for that; the fault says what to do.
    """
    agent, places = config.agent, config.places
    folder = Path(network.keys) if network.keys else keys_of_agent(agent.fleet, agent.name)
    if folder is not None:
        try:
            return _keys_of(agent, folder)
        except PancakesError as error:
            key = ("service", "network", "settings", "keys") if network.keys else ("agent", "name")
            raise ConfigError([places.fault(key, str(error))]) from None
    if agent.mdns:
        text = (
            f"needs keys of the agent {agent.name} of the fleet {agent.fleet}, because anyone can announce an address"
            " and keys decide which agent is let in: run pancakes keys join, or name the agents in peers"
        )
        raise ConfigError([places.fault(("agent", "mdns"), text)])
    addresses = keyed_addresses(agent, plugins)
    if addresses and not network.insecure:
        raise ConfigError(
            [
                places.fault(
                    ("agent", "listen" if addresses[0] in agent.listen else "peers"),
                    f"{addresses[0]!r} needs keys of the agent {agent.name} of the fleet {agent.fleet}: run pancakes"
                    f" keys join, or use {LOCAL}://{agent.name} for this machine only",
                )
            ]
        )
    return None


def _keys_of(agent: AgentConfig, folder: Path) -> Keys:
    from pancakes.security.keys import Keys  # it imports OpenSSL, which an agent without keys does not need

    keys = Keys(folder)
    if fault := fault_of_bearer(keys.own, agent.name, agent.role, agent.fleet):
        raise PancakesError(f"the keys in {folder} are not those of this agent: {fault}. Run pancakes keys join")
    return keys
