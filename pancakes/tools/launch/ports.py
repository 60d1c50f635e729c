"""The ports of a fleet: those of its files, or free ones where another program, or another fleet, has them."""

from __future__ import annotations

import contextlib
import random
import socket
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from msgspec.structs import replace

from pancakes.tools.launch.table_addresses import addresses_in, moved

NOT_LENT: Final = range(15_000, 32_000)
"""The system lends none of these ports to a program that dials, before an agent listens there."""


class Claim:
    """Keeps other launchers on this machine from some ports, also while no agent listens there yet.

    Two fleets that are started at once would else both find them free. It ends with the process at the latest. A claim
    is a socket in Linux's abstract namespace, which all users of a network namespace share, as they share its ports.
    """

    def __init__(self, held: list[socket.socket]) -> None:
        self._held = held

    @classmethod
    def to(cls, ports: Iterable[int]) -> Claim | None:
        """Claims ports; returns None where another launcher has claimed one of them."""
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
        """Gives the ports up. A second call does nothing."""
        held, self._held = self._held, []
        for it in held:
            it.close()


def claim_ports(
    tables: Mapping[str, Mapping[str, Any]], schemes: Sequence[str] = ("tcp", "udp")
) -> tuple[Claim | None, dict[str, list[str]]]:
    """Sees to it that the agents of a fleet can listen, at other ports if need be.

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
    """Returns why no program could listen there now, as a phrase; empty where one could."""
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
    """Takes a free port; the socket keeps it until it is closed, so that no two calls return the same."""
    held = socket.socket(type=_kind(scheme))
    for port in random.SystemRandom().sample(NOT_LENT, len(NOT_LENT)):
        with contextlib.suppress(OSError):
            held.bind((host, port))
            return held, port
    held.bind((host, 0))
    return held, held.getsockname()[1]
