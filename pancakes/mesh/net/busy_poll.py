"""How a thread waits for packets: asleep, or awake for a moment where the next ones come at once (busy polling).

To sleep and to be woken costs more than a packet: the processor halts, and finds its caches cold when it goes on. So
two tasks that answer each other across two processes are about three times as quick where both sides stay awake. For
packets at longer intervals the thread waits asleep, so that a battery pays for no more than that.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Final

from pancakes.runtime.kernel.inbox import LONGEST_S

BUSY_POLL_S: Final = 0.0005
"""So long the thread stays awake for the next packet, if the configuration does not say otherwise.

A round trip over TLS on a slow board must still fit in.
"""
STREAK: Final = 8
"""So many waits in a row have to end that soon before it does. Two packets that come together, as those of two agents
that tick at the same time, are no dialogue.
"""

give_way: Final[Callable[[], object] | None] = getattr(os, "sched_yield", None)

Ready = list[tuple[int, int]]
"""The numbers of sockets' files, each with what it is ready for."""


class BusyPoll:
    """Waits until sockets are ready.

    It gives way to any other process that wants the core, so that agents that share cores cost each other nothing.
    Where the system knows no way to give way, it always sleeps.

    Args:
        poll: waits for sockets, so many seconds or, with None, for ever.
        now: the host clock.
        busy_poll_s: so long it stays awake; 0: it always sleeps. May be changed.
    """

    def __init__(self, poll: Callable[[float | None], Ready], now: Callable[[], float], busy_poll_s: float) -> None:
        self._poll = poll
        self._now = now
        self.busy_poll_s = busy_poll_s
        self._streak = 0

    def wait(self, until_s: float | None) -> Ready:
        """Returns the sockets that are ready, none where none is until then (host time; None: for ever)."""
        now, poll, busy_poll_s = self._now, self._poll, self.busy_poll_s
        began_s = now_s = now()
        if self._streak >= STREAK and give_way is not None:
            end_s = began_s + busy_poll_s
            if until_s is not None and until_s < end_s:
                end_s = until_s
            while now_s < end_s:
                ready = poll(0)
                if ready:
                    return ready
                give_way()
                now_s = now()
        ready = poll(None if until_s is None else max(0.0, min(until_s - now_s, LONGEST_S)))
        self._streak = self._streak + 1 if ready and now() - began_s < busy_poll_s else 0
        return ready
