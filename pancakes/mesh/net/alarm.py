"""One call that is put off to a point in time, and to another one whenever that changes."""

from __future__ import annotations

import math
from collections.abc import Callable

from pancakes.mesh.net.transport import Scheduled, Transport


class Alarm:
    """Calls a function when it is due. In the transport's thread.

    Args:
        transport: in whose thread the function is called.
        now: the host clock.
        function: what is called.
        slack_s: so much later it is called than it is due, so that what is due soon after need not be waited for anew.

    Attributes:
        due_s: the host time for which it is set; infinity: it is not.
    """

    def __init__(
        self, transport: Transport, now: Callable[[], float], function: Callable[[], None], slack_s: float = 0.0
    ) -> None:
        self.due_s = math.inf
        self._transport = transport
        self._now = now
        self._function = function
        self._slack_s = slack_s
        self._timer: Scheduled | None = None

    def set(self, due_s: float) -> None:
        """Sets it for this time instead of any other; infinity: it is not to ring."""
        if due_s == self.due_s:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.due_s = due_s
        if due_s < math.inf:
            self._timer = self._transport.call_later(max(0.0, due_s + self._slack_s - self._now()), self._ring)

    def _ring(self) -> None:
        self._timer, self.due_s = None, math.inf
        self._function()
