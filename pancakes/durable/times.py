"""How long the steps of a migration may take, and how often they are repeated. No safety hangs on any of them."""

from __future__ import annotations

import msgspec


class Times(msgspec.Struct, frozen=True):
    """How long each step of a migration may take, and how often it is repeated.

    No safety hangs on any of them: a timer may fire at any time, early, late or never.

    Attributes:
        bid_window_s: how long a source waits for other answers once a neighbour has bid.
        patience_s: how long it waits if none has: a neighbour may import the task's class first.
        reserve_s: how long it waits for the cheapest bidder to keep room, before it asks the next one.
        slot_s: how long a destination keeps that room.
        prepare_s: how long a paused task waits for its heir to ask for it; the time of the transfer is added.
        rate_bytes_per_s: the slowest transfer that is waited for.
        resend_s: the first pause before a message is sent again.
        spread: each pause is drawn from `1 - spread` to `1 + spread` times its length.
        back_off_s: the longest pause of what never times out.
        warn_s: after this time in doubt a person is told.
        retry_write_s: how long after a failed write to the journal it is tried again.
    """

    bid_window_s: float = 0.5
    patience_s: float = 8.0
    reserve_s: float = 1.0
    slot_s: float = 5.0
    prepare_s: float = 2.0
    rate_bytes_per_s: float = 1024.0 * 1024.0
    resend_s: float = 0.2
    spread: float = 0.5
    back_off_s: float = 5.0
    warn_s: float = 5.0
    retry_write_s: float = 1.0

    def transfer_s(self, size_bytes: int) -> float:
        """Returns how long a snapshot may be on its way."""
        return size_bytes / self.rate_bytes_per_s

    def pause_s(self, attempt: int) -> float:
        """Returns the pause after the sending number `attempt` (from 0) of what never times out."""
        # 2 ** 30 times the first pause is beyond any `back_off_s`, and cannot overflow.
        return min(self.resend_s * 2.0 ** min(attempt, 30), self.back_off_s)
