"""What an agent announces of itself by DNS-SD, and what of it is believed: little. Pure.

An announcement has a name, a fleet, a port and a version, and the addresses of its machine; anyone on the network can
send any of it. So its texts are taken only if they are names, and its addresses only if they lie in a network that this
machine is in. All that an announcement brings is an address to dial: keys and rosters decide what the agent there may
do.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from ipaddress import IPv4Interface, IPv6Address, IPv6Interface, ip_address
from typing import Final

import msgspec

from pancakes.mesh.address import Address, parse_address
from pancakes.util.text import fault_of_name

SERVICE: Final = "_pancakes._tcp.local."
"""The type of the service that agents announce (RFC 6763)."""
MOST_ADDRESSES: Final = 4
"""Most addresses of one agent that are dialled."""
_LONGEST_LABEL: Final = 63
"""Most bytes in a label of DNS."""
_VERSION: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+_-]{0,31}")

Interface = IPv4Interface | IPv6Interface
"""An address of this machine, with its network."""


class Announcement(msgspec.Struct, frozen=True):
    """What an agent announces.

    Attributes:
        name: its name.
        fleet: its fleet.
        version: the version of Pancakes that it runs.
        addresses: where it says that it can be dialled, IPv4 first.
    """

    name: str
    fleet: str
    version: str
    addresses: tuple[str, ...]


def label_of(name: str, fleet: str) -> str:
    """Return the label of an agent's service, which people see in other programs that browse for services."""
    label = f"{name} ({fleet})"
    return label if len(label) <= _LONGEST_LABEL else f"{name[:40]} {_mark(name, fleet)}"


def host_of(name: str, fleet: str) -> str:
    """Return the host name of an agent's service. It is not the machine's own, which is nobody's business."""
    return f"pancakes-{_mark(name, fleet)}.local."


def texts_of(name: str, fleet: str, version: str) -> dict[str, str]:
    """Return the texts (TXT record) of an agent's service."""
    return {"name": name, "fleet": fleet, "version": version}


def announced_at(listen: Iterable[str], own: Sequence[Interface]) -> tuple[int, tuple[str, ...]]:
    """Return the port that an agent announces and the addresses of its machine there; 0: nobody could dial it.

    Args:
        listen: where it listens. Only `tcp://` with a number as its host counts, and the first port of those.
        own: the addresses of its machine.
    """
    port, hosts = 0, dict[str, None]()
    for it in map(_parsed, listen):
        if it is None or it.scheme != "tcp" or it.path or it.any_port or port not in (0, it.port):
            continue
        found = [str(mine.ip) for mine in own if _covers(it, mine)]
        if found:
            port = it.port
            hosts.update(dict.fromkeys(found))
    return port, tuple(hosts)


def read(
    port: int, texts: Mapping[bytes, bytes | None], hosts: Iterable[str], own: Sequence[Interface]
) -> Announcement:
    """Return what is believed of an announcement.

    Args:
        port: its port.
        texts: its texts.
        hosts: its addresses, as numbers.
        own: the addresses of this machine.

    Raises:
        ValueError: it is not that of an agent which could be dialled; the message says why, and shows nothing that is
            long or not printable.
    """
    name, fleet, version = (_text(texts, key) for key in ("name", "fleet", "version"))
    for text in (name, fleet):
        if fault := fault_of_name(text):
            raise ValueError(fault)
    if not _VERSION.fullmatch(version):
        version = "unknown"
    if not 0 < port < 65536:
        raise ValueError(f"{name} of the fleet {fleet} announces no port")
    near = sorted((it for it in dict.fromkeys(hosts) if _is_near(it, own)), key=lambda it: ":" in it)
    if not near:
        raise ValueError(f"{name} of the fleet {fleet} announces no address in a network of this machine")
    return Announcement(name, fleet, version, tuple(str(Address("tcp", it, port)) for it in near[:MOST_ADDRESSES]))


def _mark(name: str, fleet: str) -> str:
    return hashlib.sha256(f"{fleet}/{name}".encode()).hexdigest()[:12]


def _text(texts: Mapping[bytes, bytes | None], key: str) -> str:
    return (texts.get(key.encode()) or b"").decode("ascii", "replace")


def _parsed(address: str) -> Address | None:
    try:
        return parse_address(address)
    except ValueError:
        return None


def _covers(listening: Address, mine: Interface) -> bool:
    """Return whether who listens at an address is reached at one of this machine, from elsewhere."""
    if mine.is_loopback or (mine.is_link_local and mine.version == 6):
        return False
    if listening.everywhere:
        return ":" in listening.host or mine.version == 4
    return listening.host.partition("%")[0] == str(mine.ip)


def _is_near(host: str, own: Sequence[Interface]) -> bool:
    """Return whether an address is one of a machine in a network that this machine is in."""
    try:
        it = ip_address(host)
    except ValueError:
        return False
    if it.is_loopback or it.is_multicast or it.is_unspecified or it.is_reserved:
        return False
    if isinstance(it, IPv6Address) and it.is_link_local:
        return False  # the interface that leads there is not known
    return any(it in mine.network for mine in own)
