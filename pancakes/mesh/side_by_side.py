"""Connects to what has several addresses: tries them side by side, so that a dead one keeps nobody from a good one.

As RFC 8305 ("Happy Eyeballs") has it: IPv6 and IPv4 by turns, each a moment after the one before, or as soon as that
has failed; the first that stands is taken.
"""

from __future__ import annotations

import errno
import os
import selectors
import socket
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, Final

from pancakes.runtime.clock import MonotonicClock

PACE_S: Final = 0.25
"""So long after one address the next is tried, if there is no answer yet."""

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
