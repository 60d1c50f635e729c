"""Choose the ports of a fleet: those of its files, free ports, or none with `local://`.

The functions find and replace addresses in the tables of the agents' files, and return `--set` changes. A `Claim` keeps
other launchers on this machine from ports on which no agent listens yet.
"""

from __future__ import annotations

import contextlib
import random
import socket
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from msgspec.structs import replace

from pancakes.config.toml_writer import key_text, leaves, value_text
from pancakes.mesh.address import LOCAL, Address, local_address, parse_address, with_port


def addresses_in(value: Any) -> list[Address]:
    """Return the addresses with a port in a table, a list or a string, each once."""
    if isinstance(value, str):
        address = _address(value)
        return [address] if address is not None else []
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return list(dict.fromkeys(address for it in inner for address in addresses_in(it)))


def moved(table: Mapping[str, Any], others: Mapping[Address, str]) -> list[str]:
    """Return the `--set` changes that give an agent's file other addresses.

    Args:
        table: the values of the file.
        others: the new address for each address.
    """
    changed = [(keys, _with(value, others), value) for keys, value in leaves(table)]
    return [f"{key_text(keys)}={value_text(now)}" for keys, now, before in changed if now != before]


def _with(value: Any, others: Mapping[Address, str]) -> Any:
    if isinstance(value, list):
        return [_with(it, others) for it in value]
    address = _address(value) if isinstance(value, str) else None
    return others.get(address, value) if address is not None else value


def _address(text: str) -> Address | None:
    """Parse an address with a port; return None if the text is something else."""
    try:
        found = parse_address(with_port(text))
    except ValueError:
        return None
    return found if found.scheme in ("tcp", "udp") else None


def within_machine(tables: Mapping[str, Mapping[str, Any]], fleets: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the `--set` changes for each agent's file that replace TCP addresses by `local://` ones.

    The local address of an agent has its name. Any other listener, such as a hardware bus, is named after its port.

    Args:
        tables: the values of the agents' files, by agent.
        fleets: the agents' fleets, by agent.
    """
    own = {agent: table["agent"] for agent, table in tables.items() if isinstance(table.get("agent"), dict)}
    at_port = {
        address.port: local_address(fleets[agent], agent)
        for agent, it in own.items()
        for address in addresses_in(it.get("listen"))
    }
    found: dict[str, list[str]] = {}
    for agent, it in own.items():  # files without a table [agent] are reported when they are loaded
        table = tables[agent]
        others: dict[Address, str] = {
            address: at_port.get(address.port, f"{LOCAL}://{fleets[agent]}/port-{address.port}")
            for address in addresses_in(dict(table))
            if address.loopback and address.scheme == "tcp"
        }
        rest = {key: value for key, value in it.items() if key != "listen"}
        found[agent] = ["agent.listen=[]", *moved({**table, "agent": rest}, others)]
    return found


NOT_LENT: Final = range(15_000, 32_000)
"""Ports below the range that the system gives to outgoing connections, so that none is taken in between."""


class Claim:
    """Keep other launchers on this machine from some ports, even before an agent listens there.

    Otherwise two fleets that start at the same time would both find the ports free. A claim ends with the process at
    the latest. It is a socket in Linux's abstract namespace: like ports, all users of a network namespace share it.
    """

    def __init__(self, held: list[socket.socket]) -> None:
        self._held = held

    @classmethod
    def to(cls, ports: Iterable[int]) -> Claim | None:
        """Claim ports; return None if another launcher has claimed one of them."""
        claim = cls([])
        if sys.platform != "linux":
            return claim  # an empty claim: two launchers may find the same ports free
        for port in ports:
            held = socket.socket(socket.AF_UNIX)
            claim._held.append(held)
            try:
                held.bind(f"\0pancakes-port-{port}")
            except OSError:
                claim.release()
                return None
        return claim

    def release(self) -> None:
        """Release the ports. A second call does nothing."""
        held, self._held = self._held, []
        for it in held:
            it.close()


def claim_ports(
    tables: Mapping[str, Mapping[str, Any]], schemes: Sequence[str] = ("tcp", "udp")
) -> tuple[Claim | None, dict[str, list[str]]]:
    """Claim the ports of a fleet; if one of them is taken, choose free ports instead.

    Args:
        tables: the values of the agents' files, by agent.
        schemes: the schemes of the addresses whose ports are claimed.

    Returns:
        A claim to the ports of the files, and no changes; or, if a port is taken, no claim, and the `--set` changes for
        each agent's file that move all agents to free ports.
    """
    addresses = [address for address in addresses_in(dict(tables)) if address.scheme in schemes]
    claim = Claim.to(dict.fromkeys(address.port for address in addresses))
    if claim is not None:
        if not any(listening_fault(it.host, it.port, it.scheme) for it in addresses):
            return claim, {}
        claim.release()
    taken = [_take_free_port(address.host, address.scheme) for address in addresses]
    free = {it: str(replace(it, port=port)) for it, (_, port) in zip(addresses, taken, strict=True)}
    for held, _ in taken:
        held.close()
    return None, {agent: moved(table, free) for agent, table in tables.items()}


def listening_fault(host: str, port: int, scheme: str = "tcp") -> str:
    """Return why a program cannot listen at this address now, as a phrase; empty if it can."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, _kind(scheme)) as probe:
        if scheme == "tcp":  # with UDP, two programs could bind the same port
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return (error.strerror or str(error)).lower()
        return ""


def _kind(scheme: str) -> socket.SocketKind:
    return socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM


def _take_free_port(host: str, scheme: str) -> tuple[socket.socket, int]:
    """Return a socket bound to a free port, and the port; no other call gets this port until the socket is closed."""
    held = socket.socket(type=_kind(scheme))
    for port in random.SystemRandom().sample(NOT_LENT, len(NOT_LENT)):
        with contextlib.suppress(OSError):
            held.bind((host, port))
            return held, port
    held.bind((host, 0))
    return held, held.getsockname()[1]
