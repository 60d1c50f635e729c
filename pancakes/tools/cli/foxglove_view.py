"""Shows a running fleet in Foxglove until Ctrl-C (`pancakes view --foxglove`)."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any, Final

from msgspec.structs import replace

from pancakes.client import HeardPacket
from pancakes.errors import PancakesError, needing_extra
from pancakes.runtime.clock import wall_ns
from pancakes.tools.cli.interrupts import event_at
from pancakes.tools.cli.options import Ask
from pancakes.tools.cli.output import show_json, show_text
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket
from pancakes.tools.recording.viewing import Viewer
from pancakes.tools.web.fleet_channels import FleetChannels
from pancakes.tools.web.watch import fleet_among

LOOK_S: Final = 2.0
"""How often new channels are looked for."""


def show_in_foxglove(port: int | None, ask: Ask) -> None:
    """Serves the packets of a fleet to Foxglove until the program is interrupted.

    Args:
        port: the port on this machine; None: the usual one, or a free one where that is taken.
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
        client.narrow(fleet)
        server = FoxgloveServer(f"Pancakes, fleet {fleet}", port)
        began_ns = wall_ns() - int(client.now() * NANOSECONDS)

        def hearer() -> Callable[[HeardPacket[Any]], None]:
            viewer = Viewer()  # one for each channel, because each has a thread of its own

            def hear(heard: HeardPacket[Any]) -> None:
                packet = replace(heard.packet, destination="")  # which is this program
                entry = RecordedPacket(began_ns + int(heard.at_s * NANOSECONDS), heard.agent, packet)
                server.show_packet(entry)
                for message in viewer.messages(entry):
                    server.show(message)

            return hear

        channels = FleetChannels(client, hearer, lambda text: show_text(f"warning: {text}", err=True))
        try:
            channels.look(described)
            if ask.format_ == "json":
                show_json([{"address": server.address, "fleet": fleet}])
            else:
                show_text(f"Foxglove opens the fleet {fleet} at {server.address}")
            while not ended.wait(LOOK_S):
                try:
                    channels.look(client.survey().agents)
                except PancakesError:
                    continue  # no agent answers: it may come back
        finally:
            channels.close()
            server.close()
