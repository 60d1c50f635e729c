"""The moment of a step of the machine of hosted tasks."""

from __future__ import annotations

import msgspec

from pancakes.runtime.life.restart import Draw


class Now(msgspec.Struct, frozen=True):
    """What a rule may ask besides how the task stands.

    Attributes:
        me: this agent's name.
        now_s: host time.
        draw: draws the length of a pause.
        closing: whether the task's service ends.
        permit: of a guarded task: whether its guardians let it act.
    """

    me: str
    now_s: float
    draw: Draw
    closing: bool
    permit: bool
