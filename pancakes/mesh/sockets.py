"""Helpers for plain sockets: dial a name, check a listen address, bound kernel buffers, keep connections alive.

`connect` dials all addresses of a name side by side (RFC 8305, "Happy Eyeballs"), so that a dead one delays nobody.
`would_be_near_only` warns of a listen address that only this machine reaches: a host name may lead to the loopback,
as Debian writes the machine's own name into /etc/hosts as 127.0.1.1.

An urgent packet overtakes what waits in an agent, but not what a kernel has already. By itself Linux takes megabytes,
and a reply then waits behind them. `bound_buffers` limits that to about a quarter of a megabyte on short ways. A
machine that loses its power ends no connection, so `keep_alive` makes the kernel probe.
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import struct
import threading
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, Final

from pancakes.mesh.address import parse_address
from pancakes.util.clock import MonotonicClock

PACE_S: Final = 0.25
"""How long after one address the next one is tried, if there is no answer yet."""

Place = tuple[socket.AddressFamily, Any]
"""Where a socket may be bound or connected, in the form of the operating system."""


def by_turns(places: Sequence[Place]) -> list[Place]:
    """Return places in the order of trying: address families by turns, beginning with that of the first place."""
    first = [place for place in places if place[0] == places[0][0]]
    rest = [place for place in places if place[0] != places[0][0]]
    return [place for pair in zip_longest(first, rest) for place in pair if place is not None]


def pace_s(count: int, within_s: float) -> float:
    """Return the pause between two places, so that the last one has at least half of the time."""
    return min(PACE_S, within_s / (2 * max(1, count)))


def connect(host: str, port: int, within_s: float) -> socket.socket:
    """Connect to a host. Blocks, at most for the look-up of its name and `within_s`.

    Args:
        host: a name or a number.
        port: its port.
        within_s: how long it may take, for all addresses of the name together.

    Returns:
        The socket; its operations have the time limit `within_s` too, as with `socket.create_connection`.

    Raises:
        OSError: the name cannot be resolved, or none of its addresses answers.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    places = by_turns([(family, place) for family, _, _, _, place in found])
    tries: dict[socket.socket, None] = {}
    began_s = next_s = MonotonicClock.now()
    until_s, step_s = began_s + within_s, pace_s(len(places), within_s)
    failure: OSError = TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
    with selectors.DefaultSelector() as selector:
        try:
            while places or tries:
                now_s = MonotonicClock.now()
                if now_s >= until_s:
                    raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
                if places and (now_s >= next_s or not tries):
                    next_s = now_s + step_s
                    family, place = places.pop(0)
                    try:
                        sock = socket.socket(family, socket.SOCK_STREAM)
                    except OSError as error:  # this machine does not support the family
                        failure = error
                        continue
                    tries[sock] = None
                    sock.setblocking(False)
                    code = sock.connect_ex(place)
                    if code in (0, errno.EINPROGRESS):
                        selector.register(sock, selectors.EVENT_WRITE)
                    else:
                        failure = _failed(sock, code)
                        del tries[sock]
                    continue
                for key, _ in selector.select(min(until_s, next_s if places else until_s) - now_s):
                    sock = key.fileobj  # type: ignore[assignment]
                    selector.unregister(sock)
                    code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                    del tries[sock]
                    if not code:
                        sock.settimeout(within_s)
                        return sock
                    failure = _failed(sock, code)
            raise failure
        finally:
            for sock in tries:
                sock.close()


def _failed(sock: socket.socket, code: int) -> OSError:
    sock.close()
    return OSError(code, os.strerror(code))


LOOK_UP_S: Final = 2.0
_FIRST_FREE: Final = 1024
"""Lower ports are for privileged users only."""
_Place = tuple[socket.AddressFamily, Any]
ADVICE: Final = "write tcp://0.0.0.0:PORT for every interface, or the number that others reach this machine at"


def why_near_only(asked: str, found: str) -> str:
    """Return why other machines do not reach an agent that should be reachable, as a clause; empty: they do.

    Args:
        asked: the configured address.
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
    """Return the same for an address at which nothing listens yet; also empty if its name is not resolved soon."""
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
    """Return why no agent can listen at a TCP address on this machine, as a phrase; empty: one can.

    It does not listen there, and a port in use is not a reason: this agent itself may be running. Also empty if its
    name is not resolved soon.
    """
    wanted = parse_address(asked)
    if wanted.scheme != "tcp":
        return ""
    found, why = _look_up(wanted.host, wanted.port if wanted.port < _FIRST_FREE else 0)
    if not found:
        return why
    # As the TCP transport chooses: the first of a name's addresses that others reach.
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
    """Return the places of a name, or why it has none; neither if that is not known soon."""
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


NOT_SENT_BYTES: Final = 128 * 1024
"""How many bytes may wait for the network at the sender; with more, its socket counts as full."""
RECEIVE_BYTES: Final = 256 * 1024
"""How many bytes may wait for the reader, approximately: the kernel counts overhead too."""
SHORT_S: Final = 0.001
"""The round trip at which that is enough for 64 MB/s. For a longer one the kernel finds the right size."""

_ROUND_TRIP: Final = struct.Struct("68xI")  # tcpi_rtt of Linux's tcp_info, in microseconds


def bound_buffers(sock: socket.socket) -> None:
    """Bound the buffers of a new connection, if the system can."""
    if not hasattr(socket, "TCP_NOTSENT_LOWAT") or not hasattr(socket, "TCP_INFO"):
        return
    with contextlib.suppress(OSError):  # it may have ended already, which its next use shows
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)
        (round_trip_us,) = _ROUND_TRIP.unpack(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _ROUND_TRIP.size))
        if round_trip_us <= SHORT_S * 1e6:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)


IDLE_S: Final = 5
"""After this time without a byte the kernel probes the other side, and again at this interval."""
TRIES: Final = 3


def keep_alive(sock: socket.socket) -> None:
    """Make a TCP connection break when the other side is gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has these options; otherwise its own times apply.
    for option, value in (("TCP_KEEPIDLE", IDLE_S), ("TCP_KEEPINTVL", IDLE_S), ("TCP_KEEPCNT", TRIES)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
