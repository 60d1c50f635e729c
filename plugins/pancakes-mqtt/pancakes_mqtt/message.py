"""A message of a broker: a topic and some bytes."""

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
        retain: whether the broker keeps it for those who subscribe later; of a received one: whether it was kept, and
            so may be old.
    """

    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False

    @property
    def promised(self) -> bool:
        """Whether it must not be lost."""
        return self.qos > 0

    @property
    def weight(self) -> int:
        """Its size in bytes."""
        return len(self.topic) + len(self.payload)
