"""What several followers in one program wish to hear on one channel of one agent, asked for as one."""

from __future__ import annotations

import threading
from collections.abc import Iterable

from pancakes.client.door import Door
from pancakes.control import Follow, Unfollow

Place = tuple[str, str, str]
"""Fleet, agent and channel."""


class Wishes:
    """An agent knows one wish of a program for each channel, so theirs are put together. Any thread."""

    def __init__(self) -> None:
        # Held while a request is made and sent, so that the last one that is sent has all wishes.
        self._lock = threading.Lock()
        self._wishes: dict[Place, dict[object, Follow]] = {}

    def ask(self, follower: object, door: Door, agent: str, wish: Follow) -> int:
        """Asks an agent for what a follower wishes to hear, and for what the others do.

        Returns:
            The number of the request, for `Door.answer`.
        """
        with self._lock:
            wishes = self._wishes.setdefault((door.fleet, agent, wish.channel), {})
            wishes[follower] = wish
            return door.request(agent, together(wishes.values()))

    def drop(self, follower: object, door: Door, agent: str, channel: str) -> None:
        """Tells an agent that a follower wishes to hear nothing any more; waits for nothing."""
        with self._lock:
            wishes = self._wishes.get((door.fleet, agent, channel), {})
            if wishes.pop(follower, None) is None:
                return
            if wishes:
                number = door.request(agent, together(wishes.values()))
            else:
                del self._wishes[door.fleet, agent, channel]
                number = door.request(agent, Unfollow(channel))
            door.forget(number)


def together(wishes: Iterable[Follow]) -> Follow:
    """Returns the wish that brings what each of several wishes for one channel brings. Pure."""
    several = list(wishes)
    types = (
        () if any(not it.types for it in several) else tuple(dict.fromkeys(name for it in several for name in it.types))
    )
    most_hz = 0.0 if any(not it.most_hz for it in several) else max(it.most_hz for it in several)
    return Follow(several[0].channel, types, any(it.foreign for it in several), most_hz)
