"""Ports of a fleet: those of its files, free ones instead, or none at all with `local://`.

Addresses are found in, and replaced in, the tables of the agents' files; the result is a list of `--set` changes. A
`Claim` keeps other launchers on this machine from ports on which no agent listens yet.
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
from pancakes.mesh.address import LOCAL, Address, local_address, parse_address


def addresses_in(value: Any) -> list[Address]:
    """Return the addresses with a port in a table, or in what stands in one, each once."""
    if isinstance(value, str):
        address = _address(value)
        return [address] if address is not None else []
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return list(dict.fromkeys(address for it in inner for address in addresses_in(it)))


def moved(table: Mapping[str, Any], others: Mapping[Address, str]) -> list[str]:
    """Return what is to be set in an agent's file so that it has other addresses, as `--set` takes it.

    Args:
        table: what the file says.
        others: by address, what stands in its place.
    """
    changed = [(keys, _with(value, others), value) for keys, value in leaves(table)]
    return [f"{key_text(keys)}={value_text(now)}" for keys, now, before in changed if now != before]


def _with(value: Any, others: Mapping[Address, str]) -> Any:
    if isinstance(value, list):
        return [_with(it, others) for it in value]
    address = _address(value) if isinstance(value, str) else None
    return others.get(address, value) if address is not None else value


def _address(text: str) -> Address | None:
    """Return the address that a text is; None if it is none with a port."""
    try:
        found = parse_address(text)
    except ValueError:
        return None
    return found if found.scheme in ("tcp", "udp") else None


def within_machine(tables: Mapping[str, Mapping[str, Any]], fleets: Mapping[str, str]) -> dict[str, list[str]]:
    """Return what is to be set in each agent's file, as `--set` takes it.

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


NOT_LENT: Final = range(15_000, 32_000)
"""The system lends none of these ports to a program that dials, before an agent listens there."""


class Claim:
    """Keep other launchers on this machine from some ports, also while no agent listens there yet.

    Two fleets that are started at once would else both find them free. It ends with the process at the latest. A claim
    is a socket in Linux's abstract namespace, which all users of a network namespace share, as they share its ports.
    """

    def __init__(self, held: list[socket.socket]) -> None:
        self._held = held

    @classmethod
    def to(cls, ports: Iterable[int]) -> Claim | None:
        """Claim ports; return None if another launcher has claimed one of them."""
        claim = cls([])
        if sys.platform != "linux":
            return claim  # which claims nothing: two launchers may find the ports free
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
        """Give the ports up. A second call does nothing."""
        held, self._held = self._held, []
        for it in held:
            it.close()


def claim_ports(
    tables: Mapping[str, Mapping[str, Any]], schemes: Sequence[str] = ("tcp", "udp")
) -> tuple[Claim | None, dict[str, list[str]]]:
    """See to it that the agents of a fleet can listen, at other ports if need be.

    Args:
        tables: what the agents' files say, by agent.
        schemes: of the addresses whose ports are meant.

    Returns:
        A claim to the ports that the files name, and nothing to be set; or, where one of these ports is taken, no
        claim, and what is to be set in each agent's file so that all of them use free ones.
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
    """Return why no program could listen there now, as a phrase; empty if one could."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, _kind(scheme)) as probe:
        if scheme == "tcp":  # over UDP this would let two programs have one port
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return (error.strerror or str(error)).lower()
        return ""


def _kind(scheme: str) -> socket.SocketKind:
    return socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM


def _take_free_port(host: str, scheme: str) -> tuple[socket.socket, int]:
    """Take a free port; the socket keeps it until it is closed, so that no two calls return the same."""
    held = socket.socket(type=_kind(scheme))
    for port in random.SystemRandom().sample(NOT_LENT, len(NOT_LENT)):
        with contextlib.suppress(OSError):
            held.bind((host, port))
            return held, port
    held.bind((host, 0))
    return held, held.getsockname()[1]
