"""Show a running fleet in Foxglove until Ctrl-C (`pancakes view --foxglove`).

It subscribes to all channels of the fleet: the core channels, and the channels of tasks as soon as they exist.
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
        client: reaches the agents of one fleet.
        hearer: makes the callback for the packets of one channel. Each channel calls it in its own thread.
        say: prints a sentence if a channel cannot be subscribed to.
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
        """Subscribe to channels that are new.

        Args:
            described: the descriptions of the agents (`Client.describe`).
        """
        own = [f"{it['agent']}/{name}" for it in described for name in it["channels"] if name not in CORE_CHANNELS]
        for channel in (*CORE_CHANNELS, *own):
            if channel in self._subscribers:
                continue
            try:
                subscriber = self._client.subscribe(channel, callback=self._hearer(), include_remote=True)
            except PancakesError as error:
                if channel not in self._refused:
                    self._refused.add(channel)
                    self._say(f"{channel} is not shown: {error}")
                continue
            self._subscribers[channel] = subscriber

    def close(self) -> None:
        """End all subscribers."""
        for subscriber in self._subscribers.values():
            subscriber.close()
        self._subscribers.clear()


LOOK_S: Final = 2.0
"""The period of the search for new channels."""


def show_in_foxglove(port: int | None, ask: Ask) -> None:
    """Serve the packets of a fleet to Foxglove until the program is interrupted.

    Args:
        port: the port on this machine; None: the usual one, or a free one if the usual one is taken.
        ask: which agents to show, and how to print the address.

    Raises:
        PancakesError: no agent answers, the port is taken, or the library is missing.
    """
    with needing_extra("nothing can be served to Foxglove"):
        from pancakes.tools.web.foxglove_server import FoxgloveServer
    ended = event_at(signal.SIGINT, signal.SIGTERM)
    with ask.client() as client:
        described = client.describe().agents
        fleet = fleet_among(described, ask.where.fleet)
        client.use_fleet(fleet)
        server = FoxgloveServer(f"Pancakes, fleet {fleet}", port)
        began_ns = wall_ns() - int(client.now() * NANOSECONDS)

        def hearer() -> Callable[[ReceivedPacket[Any]], None]:
            viewer = Viewer()  # one for each channel, because each channel has its own thread

            def hear(received: ReceivedPacket[Any]) -> None:
                packet = replace(received.packet, destination="")  # the destination was this program
                entry = RecordedPacket(began_ns + int(received.at_s * NANOSECONDS), received.agent, packet)
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
                    channels.look(client.describe().agents)
                except PancakesError:
                    continue  # no agent answers now: one may come back
        finally:
            channels.close()
            server.close()
