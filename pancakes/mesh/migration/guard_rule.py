"""How a task is guarded: `[task.NAME] guard` and what belongs to it in the configuration. Pure."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

SHORTEST_LEASE_S: Final = 2.0
LONGEST_LEASE_S: Final = 600.0
PERMIT_SHARE: Final = 0.9
"""A permit is so much of a lease: the clocks of two agents may differ by 5 % in speed."""
RENEWED: Final = 4
"""So often an owner asks for a lease while one lasts."""


class GuardRule(msgspec.Struct, frozen=True):
    """Says how a task is guarded.

    Attributes:
        guard: the number of guardians.
        lease_s: how long a lease is, in host seconds.
        checkpoint_s: how often the task is written down where it has changed, in host seconds.
        guardians: agents that are to be its guardians before others.
        takeover: `auto`, or `ask`: a person confirms.
    """

    guard: Literal[3, 5]
    lease_s: Annotated[float, msgspec.Meta(ge=SHORTEST_LEASE_S, le=LONGEST_LEASE_S)] = 5.0
    checkpoint_s: Annotated[float, msgspec.Meta(ge=0.05, le=3600.0)] = 1.0
    guardians: tuple[str, ...] = ()
    takeover: Literal["auto", "ask"] = "auto"
