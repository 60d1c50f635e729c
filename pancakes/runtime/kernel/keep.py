"""How much may wait for a reader that is slow, and what then becomes of the rest."""

from __future__ import annotations

from typing import Final, Literal

import msgspec

from pancakes.errors import ClassError

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
    """Up to `limit` packets wait; then the oldest falls out, and is counted.

    Raises:
        ClassError: the limit is no whole number of at least 1.
    """
    return Keep(_checked(limit, "queue"))


def reliable(limit: int) -> Keep:
    """Up to `limit` packets wait; then publishing raises `MailboxFull`, and no subscriber gets the packet.

    Raises:
        ClassError: the limit is no whole number of at least 1.
    """
    return Keep(_checked(limit, "reliable"), reliable=True)


def keep_of(keep: Keep | Literal["latest"]) -> Keep:
    """Returns what a subscription is to do, as its author has written it.

    Raises:
        ClassError: it is nothing of that kind; it would fail whoever publishes.
    """
    if isinstance(keep, Keep):
        return keep
    if keep == "latest":
        return LATEST
    raise ClassError(f'keep is {keep!r}: write keep="latest", keep=queue(100) or keep=reliable(100)')


def _checked(limit: int, name: str) -> int:
    if type(limit) is not int or limit < 1:
        raise ClassError(f"{name} takes how many packets wait at the most, a whole number from 1, and not {limit!r}")
    return limit
