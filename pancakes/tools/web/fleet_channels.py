"""All that is said in a fleet: its core channels, and those that tasks have made, as soon as they are there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pancakes.client import Client, HeardPacket, Subscriber
from pancakes.errors import PancakesError
from pancakes.packet import CORE_CHANNELS


class FleetChannels:
    """Subscribes to all channels of the agents of a fleet.

    Args:
        client: reaches the agents; of one fleet.
        hearer: makes the function that takes the packets of one channel, in a thread of that channel.
        say: takes a sentence where a channel cannot be subscribed to.
    """

    def __init__(
        self,
        client: Client,
        hearer: Callable[[], Callable[[HeardPacket[Any]], None]],
        say: Callable[[str], None],
    ) -> None:
        self._client = client
        self._hearer = hearer
        self._say = say
        self._subscribers: dict[str, Subscriber[HeardPacket[Any]]] = {}
        self._refused: set[str] = set()

    def look(self, described: Iterable[Mapping[str, Any]]) -> None:
        """Subscribes to what is there and was not before.

        Args:
            described: what the agents say of themselves (`Client.survey`).
        """
        own = [f"{it['agent']}/{name}" for it in described for name in it["channels"] if name not in CORE_CHANNELS]
        for channel in (*CORE_CHANNELS, *own):
            if channel in self._subscribers:
                continue
            try:
                heard = self._client.subscribe(channel, callback=self._hearer(), foreign=True)
            except PancakesError as error:
                if channel not in self._refused:
                    self._refused.add(channel)
                    self._say(f"{channel} is not shown: {error}")
                continue
            self._subscribers[channel] = heard

    def close(self) -> None:
        """Ends all subscribers."""
        for heard in self._subscribers.values():
            heard.close()
        self._subscribers.clear()
