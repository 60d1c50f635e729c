"""Addresses that were to reach other machines, and that only this machine reaches: names may lead to the loopback.

Debian writes the machine's own name into /etc/hosts as 127.0.1.1.
"""

from __future__ import annotations

import socket
import threading
from typing import Final

from pancakes.mesh.address import parse_address

LOOK_UP_S: Final = 2.0
ADVICE: Final = "write tcp://0.0.0.0:PORT for every interface, or the number that others reach this machine at"


def why_near_only(asked: str, found: str) -> str:
    """Returns why only this machine reaches an agent that was to be reached from others, as a clause; empty: others do.

    Args:
        asked: the address at which it was to listen.
        found: the address at which it listens.
    """
    try:
        wanted, there = parse_address(asked), parse_address(found)
    except ValueError:
        return ""
    if wanted.path or wanted.loopback or there.path or not there.loopback:
        return ""
    return f"only this machine reaches it at {asked}: {wanted.host} is {there.host} here, as /etc/hosts may say"


def would_be_near_only(asked: str) -> str:
    """Returns the same of an address at which nothing listens yet; empty also if its name cannot be looked up soon."""
    try:
        wanted = parse_address(asked)
    except ValueError:
        return ""
    if wanted.path or wanted.loopback:
        return ""
    hosts: list[str] = []
    looking = threading.Thread(target=lambda: hosts.extend(_hosts(wanted.host)), name="resolve", daemon=True)
    looking.start()
    looking.join(LOOK_UP_S)
    found = [f"[{host}]" if ":" in host else host for host in hosts]
    reasons = [why_near_only(asked, f"{wanted.scheme}://{host}:{wanted.port}") for host in found]
    return reasons[0] if reasons and all(reasons) else ""


def _hosts(name: str) -> list[str]:
    try:
        return [str(place[0]) for *_, place in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)]
    except OSError:
        return []
