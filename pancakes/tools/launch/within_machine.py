"""A fleet that speaks within its machine alone: it takes no port, and each address of the loopback becomes a name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pancakes.mesh.address import LOCAL, Address, local_address
from pancakes.tools.launch.table_addresses import addresses_in, moved


def within_machine(tables: Mapping[str, Mapping[str, Any]], fleets: Mapping[str, str]) -> dict[str, list[str]]:
    """Returns what is to be set in each agent's file, as `--set` takes it.

    An agent is found by its name; another place where something listens, such as a hardware bus, has its port as its
    name.

    Args:
        tables: what the agents' files say, by agent.
        fleets: the agents' fleets, likewise.
    """
    own = {agent: table["agent"] for agent, table in tables.items() if isinstance(table.get("agent"), dict)}
    at_port = {
        address.port: local_address(fleets[agent], agent)
        for agent, it in own.items()
        for address in addresses_in(it.get("listen"))
    }
    found: dict[str, list[str]] = {}
    for agent, it in own.items():  # another file is not sound, and reading it as a configuration says so
        table = tables[agent]
        others: dict[Address, str] = {
            address: at_port.get(address.port, f"{LOCAL}://{fleets[agent]}/port-{address.port}")
            for address in addresses_in(dict(table))
            if address.loopback and address.scheme == "tcp"
        }
        rest = {key: value for key, value in it.items() if key != "listen"}
        found[agent] = ["agent.listen=[]", *moved({**table, "agent": rest}, others)]
    return found
