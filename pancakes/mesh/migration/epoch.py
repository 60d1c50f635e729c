"""Epochs: the order in which agents own a task. Pure."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

import msgspec

AgentName = Annotated[str, msgspec.Meta(max_length=64)]
HIGHEST: Final = 2**62
"""No peer may tell of a higher number: what is minted after it must still travel."""


class Epoch(NamedTuple):
    """How often a task was handed over, and which agent minted that number; ordered in this order.

    The next epoch offered is the hand-off's id and the fencing token in one.

    Attributes:
        n: the number; 0 at the task's birth.
        minter: the agent that owned the task when it was minted.
    """

    n: Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)]
    minter: AgentName

    def __str__(self) -> str:
        return f"{self.n}@{self.minter}" if self.minter else "none"


NO_EPOCH: Final = Epoch(0, "")
"""Lower than every epoch that was ever minted."""
MOST_STEP: Final = 10_000_000
"""An epoch may be so much higher than the one before. An adoption of a task whose record was lost takes a step of a
million for each time that it was lost.
"""
MORE_THAN_MOVES: Final = 1_000_000
"""By so much a person's decision raises the epoch of a task that was lost: by more than it can have moved. So no agent
takes the news of it for older than what it knew, and an owner can tell it from a move.
"""


def is_out_of_reach(epoch: Epoch, known: Epoch) -> bool:
    """Returns whether no task comes so far at once: from the highest epoch that is known of it to another one."""
    return epoch.n > known.n + MOST_STEP
