"""The subscriptions of an agent at a broker. Any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

from pancakes_mqtt.message import Message
from pancakes_mqtt.topics import means

Taker = Callable[[Message], None]
"""Takes a message; called in the thread of a connection."""


class Subscriptions:
    """The filters that are listened to, and which of them the broker has."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._takers: dict[str, list[tuple[int, Taker]]] = {}
        self._known: set[str] = set()
        self._refused: set[str] = set()
        self._asked: dict[int, tuple[str, int]] = {}

    def add(self, filter_: str, qos: int, taker: Taker) -> None:
        """Add a taker to a filter."""
        with self._lock:
            self._takers.setdefault(filter_, []).append((qos, taker))
            self._known.discard(filter_)  # subscribe again, so that retained messages come for this taker too

    def remove(self, taker: Taker) -> None:
        """Remove a taker from all filters."""
        with self._lock:
            for filter_ in list(self._takers):
                left = [it for it in self._takers[filter_] if it[1] != taker]
                if left:
                    self._takers[filter_] = left
                else:
                    del self._takers[filter_]

    def connected(self, session: bool) -> None:
        """Note a new connection; `session`: the broker remembers earlier subscriptions."""
        with self._lock:
            # Filters that the broker refused, or did not answer, are subscribed to again.
            self._known -= self._refused | {filter_ for filter_, _ in self._asked.values()}
            self._refused.clear()
            self._asked.clear()
            if not session:
                self._known.clear()

    def changes(self) -> tuple[dict[str, int], list[str]]:
        """Return the filters to subscribe to, with their QoS, and those to unsubscribe from."""
        with self._lock:
            wanted = {it: _qos(takers) for it, takers in self._takers.items() if it not in self._known}
            given_up = sorted(self._known - set(self._takers))
            self._known = set(self._takers)
            return wanted, given_up

    def asked(self, filter_: str, mid: int) -> None:
        """Note that a filter was subscribed to with the message of this number."""
        with self._lock:
            self._asked[mid] = (filter_, _qos(self._takers.get(filter_, [])))

    def answered(self, mid: int, refused: bool) -> tuple[str, int] | None:
        """Take the broker's answer; return the filter and the QoS of the subscription."""
        with self._lock:
            found = self._asked.pop(mid, None)
            if found is not None and refused:
                self._refused.add(found[0])
            return found

    def give(self, message: Message) -> bool:
        """Pass a message to all takers of its topic, once each; return whether there are any."""
        with self._lock:
            found = [takers for filter_, takers in self._takers.items() if means(filter_, message.topic)]
        takers = list(dict.fromkeys(take for each in found for _, take in each))
        for take in takers:
            take(message)
        return bool(takers)


def _qos(takers: list[tuple[int, Taker]]) -> int:
    return max((qos for qos, _ in takers), default=0)
