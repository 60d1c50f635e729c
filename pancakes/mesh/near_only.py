"""Addresses that were to reach other machines, and that only this machine reaches: names may lead to the loopback.

Debian writes the machine's own name into /etc/hosts as 127.0.1.1.
"""

from __future__ import annotations

import errno
import os
import socket
import threading
from typing import Any, Final

from pancakes.mesh.address import parse_address

LOOK_UP_S: Final = 2.0
_FIRST_FREE: Final = 1024
"""Ports below are only for those whom the operating system lets."""
_Place = tuple[socket.AddressFamily, Any]
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
    found, _ = _look_up(wanted.host, wanted.port)
    hosts = [str(place[0]) for _, place in found]
    shown = [f"[{host}]" if ":" in host else host for host in hosts]
    reasons = [why_near_only(asked, f"{wanted.scheme}://{host}:{wanted.port}") for host in shown]
    return reasons[0] if reasons and all(reasons) else ""


def why_not_here(asked: str) -> str:
    """Returns why this machine lets no agent listen at an address of TCP, as a phrase; empty: it may.

    Nothing listens meanwhile, and a port in use is no reason: this agent itself may run. Empty also if its name cannot
    be looked up soon.
    """
    wanted = parse_address(asked)
    if wanted.scheme != "tcp":
        return ""
    found, why = _look_up(wanted.host, wanted.port if wanted.port < _FIRST_FREE else 0)
    if not found:
        return why
    # As TCP chooses: of a name's addresses the first that others reach.
    family, place = min(found, key=lambda it: str(it[1][0]).startswith("127.") or it[1][0] == "::1")
    try:
        with socket.socket(family, socket.SOCK_STREAM) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(place)
    except OSError as error:
        text = os.strerror(error.errno or 0)
        return "" if error.errno == errno.EADDRINUSE else text[:1].lower() + text[1:]
    return ""


def _look_up(name: str, port: int) -> tuple[list[_Place], str]:
    """Returns the places of a name, and why it has none; neither if that is not known soon."""
    found: list[_Place] = []
    reasons: list[str] = []

    def look() -> None:
        try:
            all_ = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)
            found.extend((family, place) for family, *_, place in all_)
        except OSError as error:
            reasons.append(error.strerror or str(error))

    looking = threading.Thread(target=look, name="resolve", daemon=True)
    looking.start()
    looking.join(LOOK_UP_S)
    return found, "".join(reasons)
