"""What was said last of each peer: it is said again only if it is something else."""

from __future__ import annotations

from typing import Final

MOST: Final = 256
"""Of so many peers it is remembered."""


class LastSaid:
    """Remembers what was said last of each peer. One actor."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def is_news(self, peer: str, text: str) -> bool:
        """Returns whether something else was said of a peer last, or nothing."""
        said = hash(text)  # the peer may have had a part in how long it is
        is_news = self._last.pop(peer, None) != said
        self._last[peer] = said
        if len(self._last) > MOST:
            del self._last[next(iter(self._last))]
        return is_news
