"""What a transport says of the way to an address: how far it reaches, what it costs, whether others read it. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Any

import msgspec

from pancakes.mesh.address import LOCAL, is_local, is_loopback, parse_address


class Reach(IntEnum):
    """From how far an address can be dialled."""

    USER = 0
    """By programs of the agent's user, or of one group, on its machine."""
    MACHINE = 1
    """By all programs on its machine."""
    NETWORK = 2
    """From its network."""
    ROUTERS = 3
    """From each network out of which a router is reached."""


class WayFacts(msgspec.Struct, frozen=True):
    """What is known of a way.

    Attributes:
        reach: from how far it can be dialled.
        encrypted: whether what is at neither end can read nor change what is said.
        cost: the round trip of a small packet, beside that over TCP on one machine, which is 1. Of two ways to an agent
            the cheaper one is named to others.
        tells_deaths: whether the end of a connection is told within seconds, also where the other end stands still, so
            that heartbeats may rest.
    """

    reach: Reach
    encrypted: bool = False
    cost: float = 1.0
    tells_deaths: bool = False

    def plain(self) -> dict[str, Any]:
        """Returns them as plain values."""
        return {"reach": self.reach.name.lower(), "encrypted": self.encrypted, "cost": self.cost}


ReachOf = Callable[[str], Reach]
"""Returns from how far an address can be dialled."""


def reach_of(address: str) -> Reach:
    """Returns how far an address reaches of which no transport says anything else."""
    if is_local(address):
        return Reach.USER
    return Reach.MACHINE if is_loopback(address) else Reach.NETWORK


def reachable_from(remote: str, addresses: Iterable[str], reach: ReachOf = reach_of) -> tuple[str, ...]:
    """Returns those addresses that can be dialled at the other end of a connection.

    That are those which reach as far as the way by which it came: what is local is for peers that came by a local way,
    the loopback is for this machine, and an address in this network is for peers in it, not behind routers. What is
    known within one network by the name of an interface of this machine (`fe80::1%eth0`) means nothing elsewhere.

    Args:
        remote: the address of the other end, as this one sees it.
        addresses: addresses that can be dialled here.
        reach: says from how far an address can be dialled.
    """
    far = reach(remote)
    return tuple(it for it in addresses if reach(it) >= far and (far <= Reach.MACHINE or is_understood(it, remote)))


def is_understood(address: str, remote: str) -> bool:
    """Returns whether an address means on another machine what it means here.

    That of the other end itself does, by which it is seen here.

    Args:
        address: the address.
        remote: the address of the other end, as this one sees it.
    """
    try:
        there = parse_address(address)
        return not there.link_local or there.host == parse_address(remote).host
    except ValueError:
        return True


def nameable_from(remote: str, addresses: Iterable[str], reach: ReachOf) -> tuple[str, ...]:
    """Returns those addresses that a peer may name, so that this agent dials them.

    A peer elsewhere names nothing of this machine, and one behind routers nothing of this network. None names a path,
    where another program may listen.

    Args:
        remote: the address of the peer, as this agent sees it.
        addresses: what it names.
        reach: says from how far an address can be dialled.
    """
    return tuple(it for it in reachable_from(remote, addresses, reach) if not it.startswith(f"{LOCAL}:///"))
