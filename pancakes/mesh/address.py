"""Parse addresses of agents, and say from how far each can be dialled.

An address is `tcp://127.0.0.1:7401`, `tcp://[::1]:7401`, or `local://robot1` for this machine only. `Address` has its
parts, each number in one spelling. `TransportFacts` is what a transport reports of the way to an address: its reach,
whether it is encrypted, its cost. An agent names to a peer only addresses that the peer can dial. Pure.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final

import msgspec

DEFAULT_FLEET: Final = "default"
"""The fleet of agents whose configuration names none."""
DEFAULT_PORT: Final = 7401
"""The port of an agent whose `tcp://` address names none."""
LOCAL: Final = "local"
"""The scheme of addresses within one machine: `local://NAME`, `local://FLEET/NAME`, `local:///PATH`."""
MDNS: Final = "mdns:"
"""In the place of an address: the agents that announce themselves on the networks of this machine."""

_LOCAL_NAME = re.compile(r"local://(?P<name>[A-Za-z0-9_][A-Za-z0-9_.-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.-]*)?)")
_ADDRESS = re.compile(
    r"(?P<scheme>[a-z][a-z0-9+.-]*)://"
    r"(?:(?P<path>/[A-Za-z0-9._/+-]+)|(?:\[(?P<six>[A-Za-z0-9:._%-]*)\]|(?P<host>[^\[\]:/@\s]*))(?::(?P<port>[^:/\s]*))?)"
)
_HOST = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._-]*[A-Za-z0-9_.])?")


class Address(msgspec.Struct, frozen=True):
    """The parts of an address.

    Attributes:
        scheme: the name of the transport.
        host: a name or number; an IPv6 number without its brackets. Each number has one spelling: an IPv4 number that
            is mapped into an IPv6 one (`::ffff:127.0.0.1`) becomes that IPv4 number.
        port: 0 to 65535; 0 asks for a free one.
        path: a path on this computer, in the place of host and port; one that does not begin with `/` is a name
            below the directory where this user's agents are found.
    """

    scheme: str
    host: str = ""
    port: int = 0
    path: str = ""

    @property
    def any_port(self) -> bool:
        """Whether it asks for a free port, so that no other agent can dial it."""
        return not self.port and not self.path

    def __str__(self) -> str:
        if self.path:
            return f"{self.scheme}://{self.path}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    @property
    def everywhere(self) -> bool:
        """Whether it means all interfaces of a computer."""
        return self.host in ("0.0.0.0", "::")

    @property
    def link_local(self) -> bool:
        """Whether it is for one network of one computer, which its interface names (`fe80::1%eth0`)."""
        return ":" in self.host and self.host[:3] in ("fe8", "fe9", "fea", "feb")

    @property
    def loopback(self) -> bool:
        """Whether only this computer can reach it."""
        from ipaddress import ip_address

        if self.path:
            return True
        try:
            return ip_address(self.host.partition("%")[0]).is_loopback
        except ValueError:
            return self.host.lower() == "localhost"


@lru_cache(maxsize=1024)
def parse_address(text: str) -> Address:
    """Parse an address.

    Raises:
        ValueError: it is not an address; the message says why, as a phrase.
    """
    if is_local(text) and not text.startswith(f"{LOCAL}:///"):
        if named := _LOCAL_NAME.fullmatch(text):
            return Address(LOCAL, path=named["name"])
        raise ValueError(f"{text!r} is no address: write it as {LOCAL}://NAME, {LOCAL}://FLEET/NAME or {LOCAL}:///PATH")
    found = _ADDRESS.fullmatch(text)
    if not found:
        bare = text.rpartition("://")[2]
        if bare.count(":") > 1 and "[" not in bare:
            raise ValueError(f"{text!r} is no address: an IPv6 host stands in brackets, such as tcp://[::1]:7401")
        raise ValueError(f"{text!r} is no address: write it as tcp://host:port")
    if found["path"]:
        return Address(found["scheme"], path=found["path"])
    host = found["six"] if found["six"] is not None else found["host"]
    if not host:
        raise ValueError(f"{text!r} has no host: write 127.0.0.1 for this computer only, 0.0.0.0 for every interface")
    if found["six"] is not None:
        host = _six(text, host)
    elif not _HOST.fullmatch(host):
        raise ValueError(f"{text!r} has a bad host, {host!r}")
    elif re.fullmatch(r"[0-9.]+", host):
        _check_four(text, host)
    if not found["port"]:
        raise ValueError(f"{text!r} has no port: write it as {found['scheme']}://host:port")
    if not re.fullmatch(r"[0-9]{1,5}", found["port"]) or int(found["port"]) > 65535:
        raise ValueError(f"{text!r} has a bad port, {found['port']!r}: a port is a number from 0 to 65535")
    return Address(found["scheme"], host, int(found["port"]))


def fault_of_interface(text: str) -> str:
    """Return what a link-local address lacks, as a phrase; empty: nothing.

    Raises:
        ValueError: it is not an address.
    """
    there = parse_address(text)
    if not there.link_local or "%" in there.host:
        return ""
    return f"{text!r} needs the interface that leads there: write [{there.host}%eth0], with a name that ip link shows"


def with_port(text: str) -> str:
    """Return the address of an agent with its port: `tcp://robot1` is `tcp://robot1:7401`. Other text stays."""
    found = _ADDRESS.fullmatch(text)
    if found and found["scheme"] == "tcp" and not found["path"] and found["port"] is None:
        return f"{text}:{DEFAULT_PORT}"
    return text


def spelt(text: str) -> str:
    """Return an agent's address in its normal form, so that two can be compared; any other text stays as it is."""
    try:
        return str(parse_address(with_port(text)))
    except ValueError:
        return text


def dialled(text: str) -> str:
    """Return the address that `HOST` or `HOST:PORT` means; an address with a scheme and a port stays as it is.

    Raises:
        ValueError: it is not an address, or no agent can be reached there; the message says why.
    """
    address = with_port(text if "://" in text else f"tcp://{text}")
    if parse_address(address).any_port:
        raise ValueError(f"{text!r} has the port 0, at which no agent can be reached")
    if fault := fault_of_interface(address):
        raise ValueError(fault)
    return address


def local_address(fleet: str, name: str) -> str:
    """Return the address at which an agent is reached on its own machine."""
    return f"{LOCAL}://{name}" if fleet == DEFAULT_FLEET else f"{LOCAL}://{fleet}/{name}"


def in_fleet(address: str, fleet: str) -> str:
    """Return an address as an agent of a fleet means it: `local://NAME` is an agent of its own fleet."""
    name = address.removeprefix(f"{LOCAL}://")
    return local_address(fleet, name) if is_local(address) and "/" not in name else spelt(address)


def fleet_in(address: str) -> str:
    """Return the fleet in `local://NAME` or `local://FLEET/NAME`; empty: the address has none."""
    if not is_local(address) or address.startswith(f"{LOCAL}:///"):
        return ""
    first, _, rest = address.removeprefix(f"{LOCAL}://").partition("/")
    return first if rest else DEFAULT_FLEET


def is_local(address: str) -> bool:
    """Return whether an address is only for this machine, and names no port."""
    return address.startswith(f"{LOCAL}://")


@lru_cache(maxsize=1024)
def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address, as far as its text tells."""
    try:
        return parse_address(address).loopback
    except ValueError:
        return False


def _six(text: str, host: str) -> str:
    """Return the normal form of an IPv6 number.

    A socket at `[::]` sees its IPv4 peers as `::ffff:10.0.0.7`; all other sockets see `10.0.0.7`.
    """
    from ipaddress import IPv6Address

    try:
        six = IPv6Address(host)
        return str(six.ipv4_mapped or six)
    except ValueError:
        raise ValueError(f"{text!r} has a bad IPv6 host, {host!r}") from None


def _check_four(text: str, host: str) -> None:
    from ipaddress import IPv4Address

    try:
        IPv4Address(host)
    except ValueError:
        raise ValueError(f"{text!r} has a bad host, {host!r}: an IPv4 host is four numbers from 0 to 255") from None


class Reach(IntEnum):
    """From how far away an address can be dialled."""

    USER = 0
    """By programs of the agent's user, or of one group, on its machine."""
    MACHINE = 1
    """By all programs on its machine."""
    NETWORK = 2
    """From its network."""
    ROUTERS = 3
    """From any network, through routers."""


class TransportFacts(msgspec.Struct, frozen=True):
    """What is known of connections to an address.

    Attributes:
        reach: from how far away it can be dialled.
        encrypted: whether nobody between the ends can read or change the bytes.
        cost: the round trip of a small packet, where TCP on one machine is 1. Of two addresses of an agent, the
            cheaper one is named to others.
        tells_deaths: whether the end of a connection is noticed within seconds, also if the other end is paused, so
            that heartbeats may be rare.
    """

    reach: Reach
    encrypted: bool = False
    cost: float = 1.0
    tells_deaths: bool = False

    def plain(self) -> dict[str, Any]:
        """Return them as plain values."""
        return {"reach": self.reach.name.lower(), "encrypted": self.encrypted, "cost": self.cost}


ReachOf = Callable[[str], Reach]
"""Returns from how far away an address can be dialled."""


def reach_of(address: str) -> Reach:
    """Return the reach of an address if its transport is not known."""
    if is_local(address):
        return Reach.USER
    return Reach.MACHINE if is_loopback(address) else Reach.NETWORK


def reachable_from(remote: str, addresses: Iterable[str], reach: ReachOf = reach_of) -> tuple[str, ...]:
    """Return the addresses that can be dialled from the other end of a connection.

    These are the addresses that reach at least as far as the connection came: local addresses for peers on this machine
    or user, loopback addresses for this machine, and addresses in this network for peers in it. An address with the
    name of an interface of this machine (`fe80::1%eth0`) means nothing elsewhere.

    Args:
        remote: the address of the other end, as this one sees it.
        addresses: addresses that can be dialled here.
        reach: returns from how far away an address can be dialled.
    """
    far = reach(remote)
    return tuple(it for it in addresses if reach(it) >= far and (far <= Reach.MACHINE or is_understood(it, remote)))


def is_understood(address: str, remote: str) -> bool:
    """Return whether an address means the same on another machine as here.

    The address of the other end itself does.

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
    """Return the addresses that a peer may name, so that this agent dials them.

    A peer elsewhere must not name addresses of this machine, nor one behind routers addresses of this network. No peer
    may name a path, where another program may listen.

    Args:
        remote: the address of the peer, as this agent sees it.
        addresses: what it names.
        reach: returns from how far away an address can be dialled.
    """
    return tuple(it for it in reachable_from(remote, addresses, reach) if not it.startswith(f"{LOCAL}:///"))
