"""Serve packets to Foxglove over a WebSocket, in the format of a recording."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Final

import foxglove

from pancakes.errors import LocalProtocolError, PancakesError
from pancakes.recording.foxglove_messages import ViewerMessage
from pancakes.recording.message_format import SCHEMAS, data_of, schema_for
from pancakes.recording.records import RecordedPacket
from pancakes.util import codecs

ADDRESS: Final = "127.0.0.1"
PORT: Final = 8765
"""The port that Foxglove proposes."""


class FoxgloveServer:
    """Serve messages on this machine's loopback interface. All methods may be called from any thread.

    A viewer that is too slow loses the oldest messages; nothing here waits for it.

    Args:
        name: the name that viewers show.
        port: the port; None: the default port, or a free one if that is taken.

    Attributes:
        address: its address, `ws://HOST:PORT`.

    Raises:
        PancakesError: the port is taken.
    """

    def __init__(self, name: str, port: int | None) -> None:
        self._context = foxglove.Context()
        self._lock = threading.Lock()
        self._channels: dict[tuple[str, str], foxglove.Channel] = {}
        self._server = self._started(name, port)
        self.address = f"ws://{ADDRESS}:{self._server.port}"

    def close(self) -> None:
        """End all connections."""
        self._server.stop()

    def show_packet(self, entry: RecordedPacket) -> None:
        """Send a packet to the viewers that show its topic; a packet that JSON cannot express is skipped."""
        type_name = entry.packet.type
        channel = self._channel(entry.topic, SCHEMAS + type_name) or self._made(
            entry.topic, SCHEMAS + type_name, schema_for(type_name)
        )
        if channel.has_sinks():
            try:
                channel.log(data_of(entry.packet), log_time=entry.time_ns)
            except LocalProtocolError:
                return

    def show(self, message: ViewerMessage) -> None:
        """Send a message in a viewer's own schema to the viewers that show its topic."""
        channel = self._channel(message.topic, message.schema_name) or self._made(
            message.topic, message.schema_name, message.schema
        )
        channel.log(message.data, log_time=message.time_ns)

    def _started(self, name: str, port: int | None) -> foxglove.WebSocketServer:
        try:
            return foxglove.start_server(name=name, host=ADDRESS, port=port or PORT, context=self._context)
        except RuntimeError:
            if port is not None:
                raise PancakesError(f"Foxglove cannot be served at port {port}: choose another with --port") from None
        return foxglove.start_server(name=name, host=ADDRESS, port=0, context=self._context)

    def _channel(self, topic: str, schema_name: str) -> foxglove.Channel | None:
        return self._channels.get((topic, schema_name))

    def _made(self, topic: str, schema_name: str, schema: Mapping[str, object]) -> foxglove.Channel:
        with self._lock:
            if (topic, schema_name) not in self._channels:
                json_schema = foxglove.Schema(name=schema_name, encoding="jsonschema", data=codecs.encode_json(schema))
                self._channels[topic, schema_name] = foxglove.Channel(
                    topic, schema=json_schema, message_encoding="json", context=self._context
                )
            return self._channels[topic, schema_name]
