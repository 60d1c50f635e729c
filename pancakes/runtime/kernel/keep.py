"""How much may wait for a reader that is slow, and what then becomes of the rest."""

from __future__ import annotations

from typing import Final

import msgspec

MOST_BYTES: Final = 16 * 1024 * 1024
"""So many bytes of bodies wait under a subscription, besides bodies lighter than `LIGHT_BYTES`; one may always wait."""


class Keep(msgspec.Struct, frozen=True):
    """What a subscription does when its reader is slow, or the bodies that wait take more than `MOST_BYTES`.

    Attributes:
        limit: how many packets wait at the most.
        reliable: whether a packet that finds no room is refused to its publisher; else the oldest falls
            out and is counted.
    """

    limit: int
    reliable: bool = False

    @property
    def counts_losses(self) -> bool:
        """Whether a packet that falls out is lost: not where only the newest is wanted."""
        return self.reliable or self.limit > 1

    def is_full(self, waiting: int, waiting_bytes: int, weight: int) -> bool:
        """Returns whether one more packet finds no room.

        Args:
            waiting: how many packets wait.
            waiting_bytes: the bytes of the heavy ones among them.
            weight: the bytes of the packet; 0 for a light one.
        """
        return waiting >= self.limit or (waiting > 0 and weight > 0 and waiting_bytes + weight > MOST_BYTES)


LATEST = Keep(1)
"""Only the newest packet waits."""


def queue(limit: int) -> Keep:
    """Up to `limit` packets wait; then the oldest falls out, and is counted."""
    return Keep(limit)


def reliable(limit: int) -> Keep:
    """Up to `limit` packets wait; then publishing raises `MailboxFull`, and no subscriber gets the packet."""
    return Keep(limit, reliable=True)
