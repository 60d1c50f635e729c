"""The Client Service: the tasks of the user, and the channels that they talk on (paper §3.3)."""

from __future__ import annotations

import msgspec

from pancakes.services.durable import DurableService


class ClientService(DurableService):
    """Loads the user's tasks and spawns channels for what they say among each other."""

    class Settings(msgspec.Struct):
        """What it brings besides the tasks of the configuration.

        Attributes:
            channels: channels that are opened with the service.
        """

        channels: list[str] = []

    def on_start(self) -> None:
        for channel in self.settings.channels:
            self.open_channel(channel)
