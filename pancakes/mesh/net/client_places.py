"""Which client gives up its place at an agent that has as many clients as it takes. Pure.

A place is for a client that uses it: one that asks, or is sent what it follows. One that only answers pings gives its
place to the next client. Where all are in use, no machine keeps all others out: the machine with the most clients gives
one up, and some places are kept for the operator at the agent's own machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec

from pancakes.mesh.address import parse_address

IDLE_S: Final = 10.0
"""A client that neither asked nor was sent anything for so long, in host time, gives its place up to another. One that
follows a channel asks again after half of it; one that has never asked for anything is idle at once.
"""
KEPT_FOR_THIS_MACHINE: Final = 8
"""So many clients on the agent's own machine find a place, however many there are elsewhere."""
THIS_MACHINE: Final = "this machine"


class ClientPlace(msgspec.Struct, frozen=True):
    """The place of one client.

    Attributes:
        link: its link.
        machine: where it is, see `machine_of`.
        quiet_s: for how long no packet went either way, in host time; infinite where it never asked for anything.
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


def who_makes_room(machine: str, places: Sequence[ClientPlace]) -> int | None:
    """Returns the link of the client whose place a new client gets.

    Args:
        machine: where the new client is.
        places: all places, the oldest first; none is free.

    Returns:
        The link; None where all keep theirs, and the new client is refused.
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
