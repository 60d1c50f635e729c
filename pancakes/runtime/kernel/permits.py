"""Which guarded tasks may act, and until when: looked at where a turn begins and where a packet leaves."""

from __future__ import annotations

import time
from typing import Final, NamedTuple

from pancakes.runtime.clock import Clock


class PermitEnd(NamedTuple):
    """A moment by two clocks.

    Attributes:
        boot_s: the time since the machine has started, a suspend counted.
        wall_s: the time of day.
    """

    boot_s: float
    wall_s: float

    def later(self, delay_s: float) -> PermitEnd:
        """Returns the moment that comes so many host seconds after this one."""
        return PermitEnd(self.boot_s + delay_s, self.wall_s + delay_s)


_PAST: Final = PermitEnd(-1.0, -1.0)


class Permits:
    """The permits of guarded tasks, by address. Any thread.

    A permit is over as soon as either clock says so: a machine may have been suspended, and one clock be wrong.

    Args:
        host: the host clock; the only one in virtual time.
        virtual: whether it is a virtual one.
    """

    def __init__(self, host: Clock, virtual: bool) -> None:
        self._host = host
        self._virtual = virtual
        self._until: dict[str, PermitEnd] = {}

    def moment(self) -> PermitEnd:
        """Returns this moment."""
        if self._virtual:
            return PermitEnd(self._host.now(), 0.0)
        return PermitEnd(time.clock_gettime(time.CLOCK_BOOTTIME), time.time())

    def give(self, address: str, until: PermitEnd) -> None:
        """Lets a task act until a moment."""
        self._until[address] = until

    def revoke(self, address: str) -> None:
        """Lets a guarded task act no more."""
        self._until[address] = _PAST

    def free(self, address: str) -> None:
        """Lets a task act that is not guarded."""
        self._until.pop(address, None)

    def holds(self, address: str) -> bool:
        """Returns whether a task may act now."""
        if not self._until:
            return True
        until = self._until.get(address)
        return until is None or self._before(until)

    def left_s(self, address: str) -> float | None:
        """Returns for how long a guarded task may act yet, in host seconds; None: it is not guarded."""
        until = self._until.get(address)
        if until is None:
            return None
        now = self.moment()
        boot_s = until.boot_s - now.boot_s
        return max(0.0, boot_s if self._virtual else min(boot_s, until.wall_s - now.wall_s))

    def _before(self, until: PermitEnd) -> bool:
        now = self.moment()
        return now.boot_s < until.boot_s and (self._virtual or now.wall_s < until.wall_s)
