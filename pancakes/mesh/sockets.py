"""Helpers for plain sockets: dial a name, check a listen address, bound kernel buffers, keep connections alive.

`connect` dials all addresses of a name side by side (RFC 8305, "Happy Eyeballs"), so that a dead one delays nobody.
`would_be_near_only` warns of a listen address that only this machine reaches: a host name may lead to the loopback,
as Debian writes the machine's own name into /etc/hosts as 127.0.1.1.

An urgent packet overtakes what waits in an agent, but not what a kernel has already. By itself Linux takes megabytes,
which a reply then waits behind. `bound_buffers` limits that to about a quarter of a megabyte on short ways. A machine
that loses its power ends no connection, so `keep_alive` has the kernel ask.
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
"""How long after one address the next is tried, if there is no answer yet."""

Place = tuple[socket.AddressFamily, Any]
"""Where a socket may be bound or connected, as the operating system has it."""


def by_turns(places: Sequence[Place]) -> list[Place]:
    """Returns places in the order in which they are tried: the families by turns, that of the first one first."""
    first = [place for place in places if place[0] == places[0][0]]
    rest = [place for place in places if place[0] != places[0][0]]
    return [place for pair in zip_longest(first, rest) for place in pair if place is not None]


def pace_s(count: int, within_s: float) -> float:
    """Returns how long after one place the next is tried, so that the last has half of the time at least."""
    return min(PACE_S, within_s / (2 * max(1, count)))


def connect(host: str, port: int, within_s: float) -> socket.socket:
    """Connects to a host. Blocks, at most for the look-up of its name and `within_s`.

    Args:
        host: a name or a number.
        port: its port.
        within_s: how long it may take, for all addresses of the name together.

    Returns:
        The socket; what is done with it has the time limit `within_s` too, as with `socket.create_connection`.

    Raises:
        OSError: the name leads nowhere, or none of its addresses answers.
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
                    except OSError as error:  # this machine does not know the family
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


NOT_SENT_BYTES: Final = 128 * 1024
"""How much may wait for the network at the sender; beyond that its socket counts as full."""
RECEIVE_BYTES: Final = 256 * 1024
"""How much may wait for the reader, or somewhat more: the kernel counts with overhead."""
SHORT_S: Final = 0.001
"""A round trip at which that is enough for 64 MB/s. Over a longer way the kernel finds the right size by itself."""

_ROUND_TRIP: Final = struct.Struct("68xI")  # tcpi_rtt of Linux's tcp_info, in microseconds


def bound_buffers(sock: socket.socket) -> None:
    """Bounds the buffers of a new connection; does nothing if the system cannot."""
    if not hasattr(socket, "TCP_NOTSENT_LOWAT") or not hasattr(socket, "TCP_INFO"):
        return
    with contextlib.suppress(OSError):  # it may be gone already, which its next use shows
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)
        (round_trip_us,) = _ROUND_TRIP.unpack(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _ROUND_TRIP.size))
        if round_trip_us <= SHORT_S * 1e6:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)


IDLE_S: Final = 5
"""After this time without a byte the kernel asks the other side, and then as often."""
TRIES: Final = 3


def keep_alive(sock: socket.socket) -> None:
    """Has a TCP connection break when the other side is gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has these; its own times hold then.
    for option, value in (("TCP_KEEPIDLE", IDLE_S), ("TCP_KEEPINTVL", IDLE_S), ("TCP_KEEPCNT", TRIES)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
