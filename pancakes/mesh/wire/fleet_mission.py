"""Which mission time an agent takes that has just begun: that of its fleet. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

AGREE_S: Final = 1.0
"""Missions that are no further apart are one, in mission seconds: agents never begin quite together."""


class PeerMission(msgspec.Struct, frozen=True):
    """The mission of a peer.

    Attributes:
        peer: the peer.
        zero_s: the host time of the agent that asks at which it was 0; negative where that was before its clock began.
        bound_s: the truth lies no further from it, in host seconds.
        speed: mission seconds for each host second.
    """

    peer: str
    zero_s: float
    bound_s: float
    speed: float


def mission_of_fleet(missions: Sequence[PeerMission], speed: float) -> PeerMission | None:
    """Returns the mission that goes on here: that of the most peers, so that no single one misleads; of two, the older.

    Args:
        missions: those of the peers.
        speed: how fast the mission runs here; one that runs at another speed is another one.

    Returns:
        Of the peers that agree, the one of which it is known best; None: there is none.
    """
    same = [it for it in missions if it.speed == speed]
    groups = [
        [it for it in same if abs(it.zero_s - one.zero_s) * speed <= AGREE_S + (it.bound_s + one.bound_s) * speed]
        for one in same
    ]
    if not groups:
        return None
    chosen = max(groups, key=lambda group: (len(group), -min(it.zero_s for it in group)))
    return min(chosen, key=lambda it: (it.bound_s, it.peer))
