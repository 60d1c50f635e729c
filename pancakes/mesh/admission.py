"""Admission control: limit rates, unfinished handshakes, and the places for clients. Pure.

`Bucket` is a token bucket. `Handshakes` bounds how many strangers an agent talks to before it knows their
certificates, because each handshake costs a signature. `client_to_end` chooses the client that loses its place if
all are taken: first a client that only answers pings, then one from the machine with the most clients. Some places
are reserved for clients on the agent's own machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

import msgspec

from pancakes.mesh.address import parse_address


class Bucket:
    """Let a number of events through at once, and a number in each second after that.

    Args:
        at_once: how many, at first and after a pause.
        rate_hz: how many in a second.
        now_s: host time.
    """

    def __init__(self, at_once: float, rate_hz: float, now_s: float) -> None:
        self._at_once = at_once
        self._rate_hz = rate_hz
        self._room = at_once
        self._filled_s = now_s

    def take(self, number: int, now_s: float) -> bool:
        """Returns whether `number` more may happen now, all of them or none; they then count as happened."""
        self._room = min(self._at_once, self._room + (now_s - self._filled_s) * self._rate_hz)
        self._filled_s = now_s
        if self._room < number:
            return False
        self._room -= number
        return True


MOST_UNFINISHED: Final = 64
"""Of more, the oldest is given up. A handshake that is meant takes some milliseconds."""
RATE_HZ: Final = 200.0
"""How many handshakes may begin in a second."""
AT_ONCE: Final = 50.0
"""How many of them may begin at once."""

_T = TypeVar("_T")


class Handshakes(Generic[_T]):
    """The handshakes of connections that came in. In the loop's thread.

    Args:
        now_s: host time.
    """

    def __init__(self, now_s: float) -> None:
        self._unfinished: dict[_T, None] = {}
        self._beginning = Bucket(AT_ONCE, RATE_HZ, now_s)

    def may_begin(self, now_s: float) -> bool:
        """Returns whether one more may begin now; it then counts as begun."""
        return self._beginning.take(1, now_s)

    def begun(self, connection: _T) -> _T | None:
        """A handshake begins; returns the connection that must be given up for it, None: none."""
        oldest = next(iter(self._unfinished)) if len(self._unfinished) >= MOST_UNFINISHED else None
        self._unfinished[connection] = None
        return oldest

    def over(self, connection: _T) -> None:
        """A handshake has come to its end. A second call does nothing."""
        self._unfinished.pop(connection, None)


IDLE_S: Final = 10.0
"""A client that neither asked nor was sent anything for this time (host time) gives its place to another. One that
follows a channel asks again after half of it; one that has never asked for anything is idle at once.
"""
KEPT_FOR_THIS_MACHINE: Final = 8
"""How many clients on the agent's own machine find a place, however many there are elsewhere."""
THIS_MACHINE: Final = "this machine"


class ClientPlace(msgspec.Struct, frozen=True):
    """The place of one client.

    Attributes:
        link: its link.
        machine: the machine that it is on, see `machine_of`.
        quiet_s: for how long no packet went either way, in host time; infinite if it never asked for anything.
    """

    link: int
    machine: str
    quiet_s: float


def machine_of(remote: str) -> str:
    """Returns the machine at the other end of a connection, of an address such as `tcp://10.0.0.7:40022`."""
    try:
        there = parse_address(remote)
    except ValueError:
        return remote
    if there.loopback:
        return THIS_MACHINE
    return there.host


def client_to_end(machine: str, places: Sequence[ClientPlace]) -> int | None:
    """Returns the link of the client whose place a new client gets.

    Args:
        machine: the machine that the new client is on.
        places: all places, the oldest first; none is free.

    Returns:
        The link; None if all keep theirs, and the new client is refused.
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
