"""What travels over a broker: a topic and some bytes."""

from __future__ import annotations

from typing import Annotated

import msgspec

Qos = Annotated[int, msgspec.Meta(ge=0, le=2)]
"""0: at most once; 1: at least once; 2: exactly once, each between an agent and its broker."""


class Message(msgspec.Struct, frozen=True):
    """One message.

    Attributes:
        topic: its topic.
        payload: its bytes.
        qos: its quality of service.
        retain: whether the broker shall keep it for those who subscribe later; of one that came in: whether it was
            kept so, and may be old.
    """

    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False

    @property
    def promised(self) -> bool:
        """Whether it may not be lost."""
        return self.qos > 0

    @property
    def weight(self) -> int:
        """How many bytes it takes."""
        return len(self.topic) + len(self.payload)
