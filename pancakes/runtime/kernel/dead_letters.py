"""Packets that were in hand when a component failed."""

from __future__ import annotations

import threading
from collections.abc import Callable

from pancakes.packet import Packet
from pancakes.runtime.kernel.channel_queue import ChannelQueue

ATTEMPTS = 3
"""How often a reliable packet is handled before it is given up as a dead letter."""
MOST_KNOWN = 1024
"""So many packets that failed are remembered. One whose task is given up does not come again, and nothing says so."""


class DeadLetters:
    """Decides what becomes of a packet whose handler failed.

    A packet under a `reliable` subscription comes again, up to `ATTEMPTS` times in all; then, and under any other
    subscription at once, it is a dead letter: counted and logged, so that one bad packet cannot stop a task for ever.

    Args:
        log: takes a level and a line.
    """

    def __init__(self, log: Callable[[str, str], None]) -> None:
        self._log = log
        self._lock = threading.Lock()
        self._failures: dict[tuple[str, str, int], int] = {}
        self.count = 0

    def failed(self, address: str, queue: ChannelQueue, packet: Packet) -> None:
        """Takes a packet whose handler raised, in the turn of the component at `address`."""
        key = (address, packet.source, packet.seq)
        with self._lock:
            failures = self._failures.pop(key, 0) + 1
            again = queue.keep_of(packet).reliable and failures < ATTEMPTS
            if again:
                self._failures[key] = failures
                if len(self._failures) > MOST_KNOWN:
                    del self._failures[next(iter(self._failures))]  # the one that has not failed for longest
        if again:
            queue.put_back(packet)
        else:
            self.bury(
                f"{address} failed {failures} time{'s' * (failures > 1)} on {packet.type!r}"
                f" #{packet.number} from {packet.source}"
            )

    def bury(self, reason: str) -> None:
        """Counts and logs a packet that is given up. Any thread."""
        with self._lock:
            self.count += 1
        self._log("warning", f"dead letter: {reason}")
