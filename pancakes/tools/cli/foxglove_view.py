"""Show a running fleet in Foxglove until Ctrl-C (`pancakes view --foxglove`).

It subscribes to all channels of the fleet: the core channels, and those that tasks have made, as soon as they exist.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from msgspec.structs import replace

from pancakes.client import Client, ReceivedPacket, Subscriber
from pancakes.errors import PancakesError, needing_extra
from pancakes.packet import CORE_CHANNELS
from pancakes.recording.foxglove_messages import Viewer
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.tools.cli.options import Ask
from pancakes.tools.cli.output import show_text
from pancakes.tools.cli.streaming import event_at
from pancakes.tools.web.watch import fleet_among
from pancakes.util.clock import wall_ns


class FleetChannels:
    """Subscribe to all channels of the agents of a fleet.

    Args:
        client: reaches the agents; of one fleet.
        hearer: makes the function that takes the packets of one channel, in a thread of that channel.
        say: takes a sentence where a channel cannot be subscribed to.
    """

    def __init__(
        self,
        client: Client,
        hearer: Callable[[], Callable[[ReceivedPacket[Any]], None]],
        say: Callable[[str], None],
    ) -> None:
        self._client = client
        self._hearer = hearer
        self._say = say
        self._subscribers: dict[str, Subscriber[ReceivedPacket[Any]]] = {}
        self._refused: set[str] = set()

    def look(self, described: Iterable[Mapping[str, Any]]) -> None:
        """Subscribe to what is there and was not before.

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
        """End all subscribers."""
        for heard in self._subscribers.values():
            heard.close()
        self._subscribers.clear()


LOOK_S: Final = 2.0
"""How often new channels are looked for."""


def show_in_foxglove(port: int | None, ask: Ask) -> None:
    """Serve the packets of a fleet to Foxglove until the program is interrupted.

    Args:
        port: the port on this machine; None: the usual one, or a free one if that is taken.
        ask: which agents, and how the address is printed.

    Raises:
        PancakesError: there is no agent, the port is taken, or the library is missing.
    """
    with needing_extra("nothing can be served to Foxglove"):
        from pancakes.tools.web.foxglove_server import FoxgloveServer
    ended = event_at(signal.SIGINT, signal.SIGTERM)
    with ask.client() as client:
        described = client.survey().agents
        fleet = fleet_among(described, ask.where.fleet)
        client.use_fleet(fleet)
        server = FoxgloveServer(f"Pancakes, fleet {fleet}", port)
        began_ns = wall_ns() - int(client.now() * NANOSECONDS)

        def hearer() -> Callable[[ReceivedPacket[Any]], None]:
            viewer = Viewer()  # one for each channel, because each has a thread of its own

            def hear(heard: ReceivedPacket[Any]) -> None:
                packet = replace(heard.packet, destination="")  # which is this program
                entry = RecordedPacket(began_ns + int(heard.at_s * NANOSECONDS), heard.agent, packet)
                server.show_packet(entry)
                for message in viewer.messages(entry):
                    server.show(message)

            return hear

        channels = FleetChannels(client, hearer, lambda text: show_text(f"warning: {text}", err=True))
        try:
            channels.look(described)
            text = f"Foxglove opens the fleet {fleet} at {server.address}"
            ask.printer.emit([{"address": server.address, "fleet": fleet}], text)
            while not ended.wait(LOOK_S):
                try:
                    channels.look(client.survey().agents)
                except PancakesError:
                    continue  # no agent answers: it may come back
        finally:
            channels.close()
            server.close()
