"""How many strangers an agent talks to before it knows their certificates: handshakes cost a signature each. Pure."""

from __future__ import annotations

from typing import Final, Generic, TypeVar

from pancakes.mesh.net.bucket import Bucket

MOST_UNFINISHED: Final = 64
"""Of more, the oldest is given up. A handshake that is meant takes some milliseconds."""
RATE_HZ: Final = 200.0
"""So many may begin in a second."""
AT_ONCE: Final = 50.0
"""So many of them may begin at once."""

_T = TypeVar("_T")


class Handshakes(Generic[_T]):
    """The handshakes of connections that came in. In the loop's thread.

    Args:
        now_s: host time.
    """

    def __init__(self, now_s: float) -> None:
        self._unfinished: dict[_T, None] = {}
        self._beginning = Bucket(AT_ONCE, RATE_HZ, now_s)

    def may_begin(self, now_s: float) -> bool:
        """Returns whether one more may begin now; it then counts as begun."""
        return self._beginning.take(1, now_s)

    def begun(self, connection: _T) -> _T | None:
        """A handshake begins; returns the connection that is to be given up for it, None: none."""
        oldest = next(iter(self._unfinished)) if len(self._unfinished) >= MOST_UNFINISHED else None
        self._unfinished[connection] = None
        return oldest

    def over(self, connection: _T) -> None:
        """A handshake has come to its end. A second call does nothing."""
        self._unfinished.pop(connection, None)
