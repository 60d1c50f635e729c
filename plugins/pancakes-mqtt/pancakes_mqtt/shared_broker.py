"""The connection that the devices of an agent share, and which of them logs for it."""

from __future__ import annotations

import threading

from pancakes import DeviceContext
from pancakes_mqtt.broker_connection import BrokerConnection, Say
from pancakes_mqtt.broker_settings import BrokerSettings
from pancakes_mqtt.message import Message
from pancakes_mqtt.subscriptions import Taker
from pancakes_mqtt.topics import client_id_of


class SharedBroker:
    """One connection, and the devices that use it. Any thread.

    Args:
        settings: which broker.
        client_id: the name of the connection, if the settings have none.
        say: logs lines for the device that opens first.
    """

    def __init__(self, settings: BrokerSettings, client_id: str, say: Say) -> None:
        self._lock = threading.Lock()
        self._voices: dict[str, Say] = {"": say}
        self._connection = BrokerConnection(settings, client_id, self._say)
        self._connection.start()

    def join(self, device: str, say: Say) -> None:
        """Add a device that uses it."""
        with self._lock:
            self._voices.pop("", None)
            self._voices[device] = say

    def leave(self, device: str, taker: Taker | None) -> None:
        """Remove a device, which gets no more messages."""
        if taker is not None:
            self._connection.unlisten(taker)
        with self._lock:
            self._voices.pop(device, None)

    def listen(self, filter_: str, qos: int, taker: Taker) -> None:
        """Pass `taker` each message that matches the filter, in the connection's thread."""
        self._connection.listen(filter_, qos, taker)

    def publish(self, message: Message) -> bool:
        """Send a message; return False if it is lost."""
        return self._connection.publish(message)

    def close(self) -> None:
        """Send what waits, then end the connection. Does not wait for that."""
        self._connection.close()

    def _say(self, level: str, text: str) -> None:
        with self._lock:
            say = next(iter(self._voices.values()), None)
        if say is not None:
            say(level, text)


def shared_broker(context: DeviceContext, settings: BrokerSettings) -> SharedBroker:
    """Return the connection shared by all devices of this agent with the same broker settings."""
    return context.shared(
        f"mqtt {settings.connection_key}",
        lambda: SharedBroker(settings, client_id_of(context.agent, "devices"), context.log),
    )
