"""How many bytes an agent lets its peers send before it has taken them, over all its links. Pure.

A router waits for the slowest of its sessions, and with it wait all that send to that one. So what is on its way to an
agent must fit into the buffers before it, even where the agent has stopped. Each link may always have `LEAST_BYTES`
on its way. The rest of `TOTAL_BYTES` goes to links at whose other end bytes wait. Each gets half of what is left: none
takes all (dynamic thresholds: Choudhury and Hahne, IEEE/ACM Transactions on Networking 6(2), 1998).
"""

from __future__ import annotations

from typing import Final

import msgspec

TOTAL_BYTES: Final = 1024 * 1024
"""So much may be on its way to one agent, as long as it has no more than 240 links."""
LEAST_BYTES: Final = 4 * 1024
"""So much may be on its way over each link from its beginning, without a word of the receiver."""
MOST_BYTES: Final = 256 * 1024
"""No more than that is lent to one link besides: what is urgent waits at most for these."""
_KEPT_BYTES: Final = 64 * 1024
"""So much is lent even where more links than that have their least."""


class _Account(msgspec.Struct):
    """What one link has had."""

    limit: int = LEAST_BYTES
    taken: int = 0
    lent: int = 0  # of what may be on its way, that beyond the least


class CreditPool:
    """The credit of all links that end at one agent."""

    def __init__(self) -> None:
        self._accounts: dict[int, _Account] = {}
        self._lent = 0

    @property
    def on_its_way(self) -> int:
        """How many bytes may be on their way to the agent now."""
        return sum(it.limit - it.taken for it in self._accounts.values())

    def opened(self, link: int) -> None:
        """A link begins, with its least."""
        self._accounts[link] = _Account()

    def ended(self, link: int) -> None:
        """A link has ended; what it was lent is free again."""
        account = self._accounts.pop(link, None)
        if account is not None:
            self._lent -= account.lent

    def taken(self, link: int, size: int, waiting: int) -> int | None:
        """Bytes of a link were taken.

        Args:
            link: the link.
            size: how many.
            waiting: how many more wait at the sender.

        Returns:
            How many bytes of the link may be sent, from its beginning, if the sender must be told; None: it need not.

        Raises:
            ValueError: it takes more than it was granted.
        """
        account = self._accounts[link]
        if account.taken + size > account.limit:
            raise ValueError(f"{account.taken + size} bytes came where {account.limit} were granted")
        account.taken += size
        left = account.limit - account.taken
        self._lend(account, max(0, left - LEAST_BYTES))
        free = max(0, max(TOTAL_BYTES - LEAST_BYTES * len(self._accounts), _KEPT_BYTES) - self._lent)
        wanted = LEAST_BYTES + max(account.lent, min(waiting, MOST_BYTES, account.lent + free // 2))
        if wanted - left < max(LEAST_BYTES // 2, wanted // 4):
            return None
        self._lend(account, wanted - LEAST_BYTES)
        account.limit = account.taken + wanted
        return account.limit

    def _lend(self, account: _Account, lent: int) -> None:
        self._lent += lent - account.lent
        account.lent = lent
