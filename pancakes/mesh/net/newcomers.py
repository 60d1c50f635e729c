"""How many connections that are no links yet an agent keeps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from pancakes.mesh.net.session import Session

MAX_HANDSHAKES: Final = 256
"""Most connections from others that are no links yet. One more takes the place of the oldest that said no hello."""


def makes_room(sessions: Iterable[Session]) -> Session | None:
    """Returns the connection that has to go for a new one, because it is the least likely to become a link.

    It is the oldest that has not said hello, or else the oldest of all. None: there is room.

    Args:
        sessions: all connections, the oldest first.
    """
    waiting = [session for session in sessions if not session.is_up and not session.address]
    if len(waiting) < MAX_HANDSHAKES:
        return None
    mute = [session for session in waiting if session.link is None or session.link.peer is None]
    return (mute or waiting)[0]
