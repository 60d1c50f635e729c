"""How an agent changes to a new key while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from pancakes.errors import PancakesError
from pancakes.mesh.net.links import Links
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import Scheduled
from pancakes.mesh.wire.link_messages import Refusal

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys

LOOK_S: Final = 60.0
"""So often it looks whether there is a new key."""
PAUSE_S: Final = 1.0
"""So long after one link the next is made anew: an agent is never without all of them at a time."""


class Rekeying:
    """Looks for a new key, and makes the links that stand anew with it, one after the other.

    Args:
        keys: the agent's keys; None: it has none, and none of this happens.
        links: its links.
        refuse: ends a link, and tells the peer why. In the transport's thread.
        call_later: as `Transport.call_later`.
        log: takes (level, text).
    """

    def __init__(
        self,
        keys: Keys | None,
        links: Links,
        refuse: Callable[[Session, Refusal, str], None],
        call_later: Callable[[float, Callable[[], None]], Scheduled],
        log: Callable[[str, str], None],
    ) -> None:
        self._keys = keys
        self._links = links
        self._refuse = refuse
        self._call_later = call_later
        self._log = log
        self._old: deque[Session] = deque()

    def begin(self) -> None:
        """The mesh has begun. In the transport's thread."""
        if self._keys is not None:
            self._call_later(LOOK_S, self._look)

    def reload(self, dry_run: bool = False) -> bool:
        """Takes the key that lies there now; returns whether it is a new one. Any thread.

        Args:
            dry_run: whether it is only looked for.

        Raises:
            PancakesError: it cannot be used, or there are no keys.
        """
        if self._keys is None:
            raise PancakesError("it has no keys: pancakes fleet join, and start it again")
        is_new = self._keys.reload(dry_run)
        if dry_run or not is_new:
            return is_new
        self._log("info", f"there is a new key in {self._keys.folder}, and links are made anew with it")
        self._call_later(0.0, self._begin)
        return True

    def _look(self) -> None:
        try:
            self.reload()
        except PancakesError as error:
            self._log("warning", str(error))
        self._call_later(LOOK_S, self._look)

    def _begin(self) -> None:
        runs = bool(self._old)
        self._old = deque(session for session in self._links if session.certified is not None)
        if not runs:
            self._next()

    def _next(self) -> None:
        if self._old:
            # Of two links the one that ends as a duplicate is made anew by both sides, at once.
            self._refuse(self._old.popleft(), "duplicate", "there is a new key, and links are made anew")
            self._call_later(PAUSE_S, self._next)
