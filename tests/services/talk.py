"""What agents say to each other, and the events that they publish, in the order in which it happens."""

from __future__ import annotations

import re
from typing import Any

from pancakes.events import Event
from pancakes.packet import LOG, NETWORK, Packet
from pancakes.testing import Fleet


class Talk:
    """Hears the agents of a fleet.

    A message is a line like `a/client > b/client: migration.reserve`, an event one like `a/client: task_started`. An
    actor of the kernel or of a network service is named without that, `a/Guardian` say.

    Args:
        fleet: the agents.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._lines: list[tuple[str, str]] = []
        self._bodies: list[Any] = []
        for name in fleet.agents:
            self.hear(name)

    def hear(self, name: str) -> None:
        """Hears one more agent, or one that has begun again."""
        stream = self._fleet.agents[name].kernel.stream
        stream.tap(NETWORK, lambda packet: self._heard(name, packet))
        stream.tap(LOG, lambda packet: self._said(name, packet))

    def take(self, *kinds: str) -> list[str]:
        """Returns the lines since the last call.

        Args:
            *kinds: the beginnings of the kinds of messages and events that count.
        """
        lines, self._lines = self._lines, []
        return [line for kind, line in lines if kind.startswith(kinds)]

    def bodies(self) -> list[Any]:
        """Returns the bodies of all messages so far."""
        return self._bodies

    def _heard(self, name: str, packet: Packet) -> None:
        here = f"{name}/"
        if (packet.destination or "").startswith(here) and not packet.source.startswith(here):
            self._bodies.append(packet.body)
            self._note(packet.type, f"{packet.source} > {packet.destination}")

    def _said(self, name: str, packet: Packet) -> None:
        if isinstance(packet.body, Event) and packet.source.startswith(f"{name}/"):
            self._note(packet.body.kind, packet.source)

    def _note(self, kind: str, who: str) -> None:
        self._lines.append((kind, f"{re.sub('/(kernel|network)/', '/', who)}: {kind}"))
