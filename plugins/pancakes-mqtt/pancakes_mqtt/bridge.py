"""The MQTT service: channels of its agent as topics, topics as packets, and the agent's status.

[service.mqtt]
type = "mqtt"

[service.mqtt.settings]
broker = "mqtts://broker.local"
publish = [{ channel = "system", type = "pose", topic = "pancakes/{agent}/{name}" }]
take = [{ topic = "field/goal", type = "pose", channel = "network" }]
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Final

import msgspec

from pancakes import SYSCTRL, SYSTEM, Packet, PancakesError, Service, agent_of
from pancakes.devices.driver import Pace
from pancakes.errors import MailboxFullError
from pancakes.kernel.handlers import drop_oldest
from pancakes.packet import CORE_CHANNELS, body_class, field_names, known_types
from pancakes.util.text import hint_of
from pancakes_mqtt.arrivals import Arrivals
from pancakes_mqtt.bridge_tables import PublishRow, TakeRow
from pancakes_mqtt.broker_connection import BrokerConnection
from pancakes_mqtt.broker_settings import BrokerSettings
from pancakes_mqtt.message import Message
from pancakes_mqtt.packet_bodies import body_in, payload_of
from pancakes_mqtt.packets import BrokerTraffic
from pancakes_mqtt.payloads import BadPayload
from pancakes_mqtt.topics import client_id_of, fault_of_topic, filled, means

AT_ONCE: Final = 100
"""How many messages become packets in one turn."""
AGAIN_S: Final = 0.05
"""How long, in host time, a packet waits if a reader has no room for it."""
MOST_PUBLISHERS: Final = 4096
"""How many publishers' rates are remembered."""


class MqttBridge(Service):
    """Publish packets as messages, and messages as packets, as its tables say."""

    @dataclass(kw_only=True)
    class Settings(BrokerSettings):
        """The broker, and the tables.

        Attributes:
            status: the topic of its status: `online` or, even after a kill, `offline` (retained); `{agent}` is filled
                in; empty: none.
            publish: which packets of which channels become messages.
            take: which messages become packets.
            report_s: how often, in mission seconds, it reports its counters (`mqtt.traffic` on `system`).
        """

        status: str = "pancakes/{agent}/status"
        publish: list[PublishRow] = field(default_factory=list)
        take: list[TakeRow] = field(default_factory=list)
        report_s: Annotated[float, msgspec.Meta(gt=0)] = 10.0

        def __post_init__(self) -> None:
            super().__post_init__()
            if self.status and (fault := fault_of_topic(filled(self.status, {"agent": "agent"}))):
                raise ValueError(f"status: {fault}")

    settings: Any

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._connection: BrokerConnection | None = None
        self._arrivals = Arrivals(self.settings.queue)
        self._paces: dict[tuple[int, str], Pace] = {}
        self._rows_left: list[TakeRow] = []
        self._in_hand: Message | None = None
        self._taken = 0
        self._unfit = 0
        self._complained: set[str] = set()

    def on_start(self) -> None:
        if self._actor.kernel.virtual is not None:
            raise PancakesError(f"{self.address} needs a broker, which has no virtual time: leave it out then")
        settings = self.settings
        for row in settings.take:
            self._check_type(row)
        for row in (*settings.publish, *settings.take):
            if row.channel not in CORE_CHANNELS:
                self.open_channel(row.channel)
        status = filled(settings.status, {"agent": self.agent})
        self._connection = BrokerConnection(
            settings, client_id_of(self.agent, self.name), self.log, status, lasting=True
        )
        for number, row in enumerate(settings.publish):
            kind = None if row.type == "*" else row.type
            self.subscribe(row.channel, kind, partial(self._send, number, row), drop_oldest(1024))
        for row in settings.take:
            self._connection.listen(row.topic, row.qos, self._came)
        self._connection.start()
        self.after(settings.report_s, self._report)

    def on_stop(self) -> None:
        for channel, waiting in self.actor_inbox.queues.items():
            for packet in waiting.drain() if channel != SYSCTRL else ():
                self._actor.run_handlers(packet)
        self._end()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self._end()

    def _end(self) -> None:
        self._arrivals.close()
        if self._connection is not None:
            self._connection.close()

    def _check_type(self, row: TakeRow) -> None:
        cls = body_class(row.type)
        if cls is None:
            hint = hint_of(row.type, known_types())
            raise PancakesError(
                f"{self.address} takes {row.topic}: no packet type {row.type!r} is installed here{hint}"
            )
        if unknown := next((name for name in row.fields if name not in field_names(cls)), None):
            hint = hint_of(unknown, field_names(cls))
            raise PancakesError(f"{self.address} takes {row.topic}: {row.type} has no field {unknown!r}{hint}")

    # Packets that become messages ------------------------------------------------------------------------------

    def _send(self, number: int, row: PublishRow, packet: Packet) -> None:
        if packet.source == self.address or (not row.others and agent_of(packet.source) != self.agent):
            return
        if not self._is_due(number, row, packet.source):
            return
        places = {
            "agent": self.agent,
            "source": packet.source,
            "name": packet.source.rpartition("/")[2],
            "channel": packet.channel,
            "type": packet.type,
        }
        try:
            payload = payload_of(packet, row.payload == "packet")
        except BadPayload as error:
            self._complain(f"a packet {packet.type} of {packet.source} is not published: {error}")
            return
        assert self._connection is not None
        self._connection.publish(Message(filled(row.topic, places), payload, row.qos, row.retain))

    def _is_due(self, number: int, row: PublishRow, source: str) -> bool:
        if row.max_hz is None:
            return True
        if len(self._paces) >= MOST_PUBLISHERS:
            self._paces.clear()
        pace = self._paces.setdefault((number, source), Pace(row.max_hz))
        return pace.due(self.now())

    # Messages that become packets ------------------------------------------------------------------------------

    def _came(self, message: Message) -> None:
        """Take a message. In the connection's thread, which waits while there is no room for a promised message."""
        if self._arrivals.put(message):
            self.call(self._take_all)

    def _take_all(self) -> None:
        for _ in range(AT_ONCE):
            if self._in_hand is None and not self._take_next():
                self._arrivals.answered()
                break
            if not self._publish_in_hand():
                self.after_host(AGAIN_S, self._take_all)
                return
        else:  # other actors have their turn
            self.call(self._take_all)
            return
        if self._arrivals.ring():  # a message has come meanwhile
            self.call(self._take_all)

    def _take_next(self) -> bool:
        self._in_hand = message = self._arrivals.take()
        if message is None:
            return False
        rows = (row for row in self.settings.take if means(row.topic, message.topic))
        self._rows_left = [row for row in rows if row.retained or not message.retain]
        return True

    def _publish_in_hand(self) -> bool:
        """Publish a message as packets, by each row that matches it; return False if a reader has no room."""
        message = self._in_hand
        assert message is not None
        while self._rows_left:
            row = self._rows_left[0]
            try:
                body, left_out = body_in(message.payload, row.type, row.fields)
                if left_out:
                    self._complain(f"a part of a message on {message.topic} is left out: {'; '.join(left_out)}")
                self.publish(row.channel, body, row.to)
                self._taken += 1
            except MailboxFullError:
                return False
            except (BadPayload, PancakesError) as error:
                self._unfit += 1
                self._complain(f"a message on {message.topic} is not a {row.type}: {error}")
            self._rows_left.pop(0)
        self._in_hand = None
        return True

    # How it fares ----------------------------------------------------------------------------------------------

    def _report(self) -> None:
        assert self._connection is not None
        counts, overflowed = self._connection.counts(), self._arrivals.fallen_out
        self.publish(
            SYSTEM,
            BrokerTraffic(
                counts.connected,
                counts.connections,
                counts.published,
                counts.unsent,
                counts.waiting,
                self._taken,
                overflowed,
                self._unfit + counts.oversized,
            ),
        )
        self._complained.clear()
        self.after(self.settings.report_s, self._report)

    def _complain(self, text: str) -> None:
        # Logged once between two reports: a publisher that does not fit a table would flood the log.
        if text not in self._complained and len(self._complained) < AT_ONCE:
            self._complained.add(text)
            self.log("warning", text)
