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
LOCAL: Final = "local"
"""The scheme of addresses within one machine: `local://NAME`, `local://FLEET/NAME`, `local:///PATH`."""

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
            is mapped into an IPv6 one (`::ffff:127.0.0.1`) is that IPv4 number.
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
    """Takes an address apart.

    Raises:
        ValueError: it is none; the message says why, as a phrase.
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
        raise ValueError(f"{text!r} has no host: write 127.0.0.1 for this computer alone, 0.0.0.0 for every interface")
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
    """Returns what an address of one network lacks so that it leads anywhere, as a phrase; empty: nothing.

    Raises:
        ValueError: it is not an address.
    """
    there = parse_address(text)
    if not there.link_local or "%" in there.host:
        return ""
    return f"{text!r} needs the interface that leads there: write [{there.host}%eth0], with a name that ip link shows"


def spelt(text: str) -> str:
    """Returns an address in the one spelling that it has, so that two can be compared; what is none stays as it is."""
    try:
        return str(parse_address(text))
    except ValueError:
        return text


def dialled(text: str) -> str:
    """Returns the address that `HOST:PORT` means, or an address with its transport as it is.

    Raises:
        ValueError: it is none, or none at which an agent could be reached; the message says why.
    """
    address = text if "://" in text else f"tcp://{text}"
    if parse_address(address).any_port:
        raise ValueError(f"{text!r} has the port 0, at which no agent can be reached")
    if fault := fault_of_interface(address):
        raise ValueError(fault)
    return address


def local_address(fleet: str, name: str) -> str:
    """Returns the address at which an agent is reached on its own machine."""
    return f"{LOCAL}://{name}" if fleet == DEFAULT_FLEET else f"{LOCAL}://{fleet}/{name}"


def in_fleet(address: str, fleet: str) -> str:
    """Returns what an address means to an agent of a fleet: `local://NAME` is a neighbour, not one of another fleet."""
    name = address.removeprefix(f"{LOCAL}://")
    return local_address(fleet, name) if is_local(address) and "/" not in name else spelt(address)


def fleet_in(address: str) -> str:
    """Returns the fleet that `local://NAME` or `local://FLEET/NAME` names; empty: another address names none."""
    if not is_local(address) or address.startswith(f"{LOCAL}:///"):
        return ""
    first, _, rest = address.removeprefix(f"{LOCAL}://").partition("/")
    return first if rest else DEFAULT_FLEET


def is_local(address: str) -> bool:
    """Returns whether an address is only for this machine, and names no port."""
    return address.startswith(f"{LOCAL}://")


@lru_cache(maxsize=1024)
def is_loopback(address: str) -> bool:
    """Returns whether only this machine can reach an address, as far as can be seen."""
    try:
        return parse_address(address).loopback
    except ValueError:
        return False


def _six(text: str, host: str) -> str:
    """Returns the one spelling of an IPv6 number.

    A socket at `[::]` sees its IPv4 peers as `::ffff:10.0.0.7`, and everybody else as `10.0.0.7`.
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
    """From how far an address can be dialled."""

    USER = 0
    """By programs of the agent's user, or of one group, on its machine."""
    MACHINE = 1
    """By all programs on its machine."""
    NETWORK = 2
    """From its network."""
    ROUTERS = 3
    """From each network out of which a router is reached."""


class TransportFacts(msgspec.Struct, frozen=True):
    """What is known of a way.

    Attributes:
        reach: from how far it can be dialled.
        encrypted: whether what is at neither end can read nor change what is said.
        cost: the round trip of a small packet, beside that over TCP on one machine, which is 1. Of two ways to an agent
            the cheaper one is named to others.
        tells_deaths: whether the end of a connection is told within seconds, also if the other end is paused, so
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
