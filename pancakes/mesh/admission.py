"""Admission control: limit rates, unfinished handshakes, and the places for clients. Pure.

`Bucket` is a token bucket. `Handshakes` bounds how many strangers an agent talks to before it knows their
certificates, because each handshake costs a signature. `client_to_end` chooses the client that loses its place if all
places are taken: first a client that only answers pings, then one from the machine with the most clients. Some places
are reserved for clients on the agent's own machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

import msgspec

from pancakes.mesh.address import parse_address


class Bucket:
    """A token bucket: let a burst of events through, and then a number each second.

    Args:
        at_once: the size of a burst.
        rate_hz: events in a second.
        now_s: host time.
    """

    def __init__(self, at_once: float, rate_hz: float, now_s: float) -> None:
        self._at_once = at_once
        self._rate_hz = rate_hz
        self._room = at_once
        self._filled_s = now_s

    def take(self, number: int, now_s: float) -> bool:
        """Return whether `number` more events may happen now, all or none; if so, count them."""
        self._room = min(self._at_once, self._room + (now_s - self._filled_s) * self._rate_hz)
        self._filled_s = now_s
        if self._room < number:
            return False
        self._room -= number
        return True


MOST_UNFINISHED: Final = 64
"""If there are more, the oldest is ended. An honest handshake takes some milliseconds."""
RATE_HZ: Final = 200.0
"""How many handshakes may begin in a second."""
AT_ONCE: Final = 50.0
"""How many of them may begin at once."""

_T = TypeVar("_T")


class Handshakes(Generic[_T]):
    """The handshakes of incoming connections. In the loop's thread.

    Args:
        now_s: host time.
    """

    def __init__(self, now_s: float) -> None:
        self._unfinished: dict[_T, None] = {}
        self._beginning = Bucket(AT_ONCE, RATE_HZ, now_s)

    def may_begin(self, now_s: float) -> bool:
        """Return whether one more may begin now; if so, count it."""
        return self._beginning.take(1, now_s)

    def begun(self, connection: _T) -> _T | None:
        """Add a handshake that begins; return the connection that must end for it, or None."""
        oldest = next(iter(self._unfinished)) if len(self._unfinished) >= MOST_UNFINISHED else None
        self._unfinished[connection] = None
        return oldest

    def over(self, connection: _T) -> None:
        """Remove a handshake that has ended. A second call does nothing."""
        self._unfinished.pop(connection, None)


IDLE_S: Final = 10.0
"""A client without packets either way for this time (host time) gives its place to another. One that follows a channel
asks again after half of it; one that has never sent a request is idle at once.
"""
KEPT_FOR_THIS_MACHINE: Final = 8
"""Places that are reserved for clients on the agent's own machine."""
THIS_MACHINE: Final = "this machine"


class ClientPlace(msgspec.Struct, frozen=True):
    """The place of one client.

    Attributes:
        link: its link.
        machine: its machine, see `machine_of`.
        quiet_s: for how long no packet went either way, in host time; infinite if it never sent a request.
    """

    link: int
    machine: str
    quiet_s: float


def machine_of(remote: str) -> str:
    """Return the machine at the other end of a connection, of an address such as `tcp://10.0.0.7:40022`."""
    try:
        there = parse_address(remote)
    except ValueError:
        return remote
    if there.loopback:
        return THIS_MACHINE
    return there.host


def client_to_end(machine: str, places: Sequence[ClientPlace]) -> int | None:
    """Return the link of the client whose place a new client gets.

    Args:
        machine: the machine of the new client.
        places: all places, which are taken, the oldest first.

    Returns:
        The link; None if the new client is refused.
    """
    idle = [place for place in places if place.quiet_s >= IDLE_S]
    if idle:
        return _quietest(idle)
    crowd = Counter(place.machine for place in places)
    if machine == THIS_MACHINE and crowd[machine] < KEPT_FOR_THIS_MACHINE:
        return _quietest([place for place in places if place.machine != machine])
    largest, count = crowd.most_common(1)[0]
    if crowd[machine] + 1 < count:
        return _quietest([place for place in places if place.machine == largest])
    return None


def _quietest(places: Sequence[ClientPlace]) -> int:
    return max(places, key=lambda place: place.quiet_s).link
