"""One connection to one broker, and the thread that keeps it open."""

from __future__ import annotations

import atexit
import random
import select
import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.mesh.sockets import connect
from pancakes.util.clock import MonotonicClock
from pancakes_mqtt.broker_settings import BrokerSettings, check_files, password_of
from pancakes_mqtt.message import Message
from pancakes_mqtt.refusals import TAKEN_OVER, why_refused, why_unreachable
from pancakes_mqtt.spool import Spool
from pancakes_mqtt.subscriptions import Subscriptions, Taker
from pancakes_mqtt.tls_context import tls_context

if TYPE_CHECKING:
    from paho.mqtt.client import Client

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 10.0
"""The pause, in host time, before a missing broker is tried again."""
STEADY_S: Final = 5.0
"""A connection that ends before this does not count as good: the pause keeps growing."""
CONNECT_S: Final = 3.0
"""How long connecting may take."""
LAST_WORDS_S: Final = 1.0
"""How long waiting messages may take to leave when the connection closes."""
IN_FLIGHT: Final = 20
"""How many messages (QoS 1 and 2) may be in flight to the broker at a time."""
MANY: Final = 3
"""After this many short connections in a row, two clients with one name are suspected."""
UNSPECIFIED: Final = 0x80
ONLINE: Final = b"online"
OFFLINE: Final = b"offline"
GROUND_S: Final = 0.5
BESIDE_PAYLOAD_BYTES: Final = 66_000
"""The overhead of a message besides its payload: mainly its topic."""

Say = Callable[[str, str], None]
"""Logs a line: its level and its text. Any thread."""


class Counts(msgspec.Struct, frozen=True):
    """Counters of a connection's messages; see `pancakes_mqtt.packets.BrokerTraffic`."""

    connected: bool = False
    connections: int = 0
    published: int = 0
    unsent: int = 0
    waiting: int = 0
    oversized: int = 0


class BrokerConnection:
    """Keep a connection to a broker in its own thread, once started; paho is used only there.

    A missing broker is tried again until it is there. Meanwhile promised messages (QoS 1 and 2) wait in both
    directions, as far as there is room; others are dropped and counted.

    Args:
        settings: which broker.
        client_id: the connection's name, if the settings have none.
        say: logs lines.
        status: the topic of the status, with a last will; empty: none.
        lasting: whether the broker keeps messages for the next connection after this one was closed.

    Raises:
        PancakesError: a file in the settings cannot be used.
    """

    def __init__(self, settings: BrokerSettings, client_id: str, say: Say, status: str = "", lasting: bool = False):
        self._settings = settings
        self._say = say
        self._status = status
        self._lasting = lasting
        self._client_id = settings.client_id or client_id
        self._spool = Spool(settings.queue)
        self._lock = threading.Lock()
        self._counts = Counts()
        self._subscriptions = Subscriptions()
        self._wake_in, self._wake_out = socket.socketpair()
        for end in (self._wake_in, self._wake_out):
            end.setblocking(False)
        self._ending = threading.Event()
        # The rest is used only by the thread.
        self._in_flight: set[int] = set()
        self._window = IN_FLIGHT
        self._best_qos = 2
        self._largest: int | None = None
        self._refused = ""
        self._why = ""
        self._said: set[str] = set()
        self._pause_s = FIRST_PAUSE_S
        self._since_s = 0.0
        self._brief = 0
        self._random = random.Random(self._client_id)  # agents that lost a broker do not all return at once
        self._clock = MonotonicClock()
        try:
            self._client = self._make_client()
        except BaseException:
            self._wake_in.close()
            self._wake_out.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"mqtt-{self._client_id}", daemon=True)

    # Any thread ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to connect. Filters that are added before this miss no kept message."""
        # A process waits for its last messages: perhaps a switch must be turned off.
        atexit.register(self._outlast)
        self._thread.start()

    def publish(self, message: Message) -> bool:
        """Send a message; a promised one waits for a broker. Return False if it is lost."""
        with self._lock:
            connected = self._counts.connected
        if not connected and not message.promised:
            self._count(unsent=1)
            return False
        if not self._spool.put(message):
            return False
        self._wake()
        return True

    def listen(self, filter_: str, qos: int, taker: Taker) -> None:
        """Pass `taker` each message that matches the filter, in this connection's thread, also after reconnecting."""
        self._subscriptions.add(filter_, qos, taker)
        self._wake()

    def unlisten(self, taker: Taker) -> None:
        """Undo `listen`."""
        self._subscriptions.remove(taker)
        self._wake()

    def counts(self) -> Counts:
        """Return the counters of messages."""
        with self._lock:
            counts = self._counts
        return msgspec.structs.replace(
            counts, waiting=len(self._spool) + len(self._in_flight), unsent=counts.unsent + self._spool.fallen_out
        )

    def close(self) -> None:
        """Send what waits, publish `offline`, and end. Does not wait for that."""
        self._ending.set()
        self._wake()

    def _outlast(self) -> None:
        if self.counts().connected:
            self._thread.join(LAST_WORDS_S)

    def _wake(self) -> None:
        try:
            self._wake_in.send(b"\0")
        except OSError:
            pass  # it is full, so the thread wakes; or it is closed, because the thread has ended

    def _count(self, **more: int) -> None:
        with self._lock:
            sums = {name: getattr(self._counts, name) + count for name, count in more.items()}
            self._counts = msgspec.structs.replace(self._counts, **sums)

    # The thread ------------------------------------------------------------------------------------------------

    def _make_client(self) -> Client:
        import paho.mqtt.client as paho

        settings = self._settings
        five = settings.protocol == "5"

        class SideBySide(paho.Client):
            """Connect to several addresses at once; paho tries one after the other, each with the whole time."""

            def _create_socket_connection(self) -> socket.socket:
                return connect(settings.host, settings.port, CONNECT_S)

        client = SideBySide(
            paho.CallbackAPIVersion.VERSION2,
            self._client_id,
            protocol=paho.MQTTv5 if five else paho.MQTTv311,
            reconnect_on_failure=False,
            clean_session=None if five else settings.session_s == 0,
        )
        client.connect_timeout = CONNECT_S
        if settings.user:
            client.username_pw_set(settings.user, password_of(settings) or None)
        if settings.encrypted:
            check_files(settings)
            client.tls_set_context(tls_context(settings))
        if self._status:
            client.will_set(self._status, OFFLINE, qos=1, retain=True)
        # From here on `reconnect` connects: `connect` would begin a new session each time.
        client.connect_async(settings.host, settings.port, settings.keepalive_s, **self._session())
        client.on_connect = self._connected
        client.on_disconnect = self._disconnected
        client.on_subscribe = self._subscribed
        client.on_publish = self._published
        client.on_message = self._came
        return client

    def _session(self) -> dict[str, Any]:
        """Return the session options for MQTT 5.0; 3.1.1 only has whether there is a session."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        settings = self._settings
        if settings.protocol != "5":
            return {}
        properties = Properties(PacketTypes.CONNECT)
        properties.SessionExpiryInterval = settings.session_s
        properties.MaximumPacketSize = min(settings.largest_bytes + BESIDE_PAYLOAD_BYTES, 0xFFFFFFFF)
        # Never a clean start: mosquitto 2.0 does not save such a session to disk.
        return {"properties": properties, "clean_start": settings.session_s == 0}

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._refused = self._why = ""
                try:
                    self._client.reconnect()
                    self._attend()
                except OSError as error:
                    self._why = why_unreachable(error, self._settings.encrypted)
                except ValueError as error:  # of paho: the broker breaks the protocol
                    self._why = f"it does not speak MQTT ({error})"
                self._lost()
        finally:
            atexit.unregister(self._outlast)
            self._spool.close()
            self._wake_in.close()
            self._wake_out.close()

    def _attend(self) -> None:
        """Serve the connection until it ends."""
        client = self._client
        until_s = None
        while (broker := client.socket()) is not None:
            if self._ending.is_set():
                until_s = until_s or self._say_good_bye()
                if self._clock.now() > until_s or not (self._in_flight or len(self._spool) or client.want_write()):
                    self._hang_up()
                    return
            self._feed()
            if (broker := client.socket()) is None:
                return
            poll = select.poll()
            poll.register(broker, select.POLLIN | (select.POLLOUT if client.want_write() else 0))
            poll.register(self._wake_out, select.POLLIN)
            more = getattr(broker, "pending", lambda: 0)()  # TLS has decoded more than was read
            events = dict(poll.poll(0 if more else 1000 * GROUND_S if until_s is None else 50))
            if self._wake_out.fileno() in events:
                self._sleep_on()
            if more or events.get(broker.fileno(), 0) & ~select.POLLOUT:
                client.loop_read()
            if client.want_write():
                client.loop_write()
            client.loop_misc()

    def _sleep_on(self) -> None:
        try:
            while self._wake_out.recv(4096):
                pass
        except OSError:
            pass

    def _feed(self) -> None:
        """Pass waiting messages to paho, but only few at a time."""
        client = self._client
        if not client.is_connected():
            return
        self._subscribe()
        while len(self._in_flight) < self._window and not client.want_write():
            message = self._spool.take()
            if message is None:
                return
            self._send(message)

    def _send(self, message: Message) -> None:
        qos = min(message.qos, self._best_qos)
        if qos < message.qos:
            self._say_once("warning", f"the broker takes QoS {qos} at the most: {message.topic} is published with that")
        if self._largest is not None and message.weight + 16 > self._largest:
            self._count(unsent=1)
            self._say_once(
                "error", f"a message on {message.topic} has {message.weight} bytes; the broker takes {self._largest}"
            )
            return
        try:
            told = self._client.publish(message.topic, message.payload, qos, message.retain)
        except ValueError as error:
            self._count(unsent=1)
            self._say_once("error", f"nothing can be published on {message.topic!r}: {error}")
            return
        if qos:
            self._in_flight.add(told.mid)  # paho sends it again if the connection is lost
        elif told.rc:
            self._count(unsent=1)
        else:
            self._count(published=1)

    def _subscribe(self) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        wanted, given_up = self._subscriptions.changes()
        for filter_, qos in wanted.items():
            more: dict[str, Any] = (
                {"options": SubscribeOptions(qos=qos)} if self._settings.protocol == "5" else {"qos": qos}
            )
            _, mid = self._client.subscribe(filter_, **more)
            if mid is not None:
                self._subscriptions.asked(filter_, mid)
        for filter_ in given_up:
            self._client.unsubscribe(filter_)

    def _say_good_bye(self) -> float:
        """Begin to close: send the last message. Return when to end at the latest, in host time."""
        if self._status and self._client.is_connected():
            self._spool.put(Message(self._status, OFFLINE, 1, True))
        return self._clock.now() + LAST_WORDS_S

    def _hang_up(self) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = None
        if self._settings.protocol == "5" and not self._lasting:
            properties = Properties(PacketTypes.DISCONNECT)
            properties.SessionExpiryInterval = 0
        self._client.disconnect(properties=properties)
        until_s = self._clock.now() + GROUND_S
        while (broker := self._client.socket()) is not None and self._clock.now() < until_s:
            poll = select.poll()
            poll.register(broker, select.POLLOUT)
            poll.poll(50)
            self._client.loop_write()
        if (broker := self._client.socket()) is not None:
            broker.close()

    def _lost(self) -> None:
        """Handle a lost or failed connection: log it once, drop messages that are not promised, and wait."""
        with self._lock:
            was = self._counts.connected
            self._counts = msgspec.structs.replace(self._counts, connected=False)
        self._spool.forget_unpromised()
        if self._ending.is_set():
            return
        if was:
            self._note_how_long()
        where, reason = self._settings.broker, self._refused or self._why or "it ended the connection"
        if self._refused:
            self._say_once("error", f"the broker {where} refuses {self._client_id}: {reason}")
        elif was:
            self._say("warning", f"the broker {where} is gone ({reason}); trying until it is there again")
            self._said.add(_not_there(where, reason))
        else:
            self._say_once("warning", _not_there(where, reason))
        poll = select.poll()
        poll.register(self._wake_out, select.POLLIN)
        until_s = self._clock.now() + self._pause_s * self._random.uniform(0.75, 1.0)
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        while not self._ending.is_set() and (left_s := until_s - self._clock.now()) > 0:
            if poll.poll(1000 * left_s + 1):
                self._sleep_on()

    def _note_how_long(self) -> None:
        if self._clock.now() - self._since_s >= STEADY_S:
            self._pause_s, self._brief = FIRST_PAUSE_S, 0
            return
        self._brief += 1
        if self._brief >= MANY and not self._why:
            self._why = f"it ends one connection after the other: is another one called {self._client_id}, too?"

    def _say_once(self, level: str, text: str) -> None:
        """Log a line only once until the next connection."""
        if text not in self._said:
            self._said.add(text)
            self._say(level, text)

    # Called by paho, in the thread -----------------------------------------------------------------------------

    def _connected(self, client: Client, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._refused = why_refused(reason.value, reason.getName())
            return
        self._said.clear()
        self._since_s = self._clock.now()
        self._window = min(IN_FLIGHT, getattr(properties, "ReceiveMaximum", IN_FLIGHT))
        self._best_qos = getattr(properties, "MaximumQoS", 2)
        self._largest = getattr(properties, "MaximumPacketSize", None)
        with self._lock:
            connections = self._counts.connections + 1
            self._counts = msgspec.structs.replace(self._counts, connected=True, connections=connections)
        self._subscriptions.connected(bool(flags.session_present))
        if self._status:
            self._spool.put(Message(self._status, ONLINE, 1, True))
        self._say("info", f"connected to the broker {self._settings.broker} as {self._client_id}")

    def _disconnected(self, client: Client, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._why = why_refused(reason.value, reason.getName())
            if reason.value == TAKEN_OVER:
                self._pause_s = LONGEST_PAUSE_S  # otherwise the two would replace each other without end
        elif reason.is_failure and reason.value != UNSPECIFIED and not self._why:
            self._why = reason.getName().lower()

    def _subscribed(self, client: Client, data: Any, mid: int, reasons: Any, properties: Any) -> None:
        granted = reasons[0].value if reasons else 0x80
        found = self._subscriptions.answered(mid, granted >= 0x80)
        if found is None:
            return
        filter_, qos = found
        if granted >= 0x80:
            self._say_once(
                "error", f"the broker does not let this agent hear {filter_}: {reasons[0].getName().lower()}"
            )
        elif granted < qos:
            self._say_once("warning", f"the broker sends {filter_} with QoS {granted} at the most, not {qos}")

    def _published(self, client: Client, data: Any, mid: int, reason: Any, properties: Any) -> None:
        if mid not in self._in_flight:
            return
        self._in_flight.discard(mid)
        if reason.is_failure:
            self._count(unsent=1)
            self._say_once("error", f"the broker refuses what this agent publishes: {reason.getName().lower()}")
        else:
            self._count(published=1)

    def _came(self, client: Client, data: Any, message: Any) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self._say_once("warning", "a message came on a topic that is not UTF-8")
            return
        if (size := len(message.payload)) > self._settings.largest_bytes:
            self._count(oversized=1)
            most = f"largest_bytes = {self._settings.largest_bytes}"
            self._say_once("warning", f"a message on {topic} is not taken: it has {size} bytes, and {most}")
            return
        came = Message(topic, message.payload, message.qos, bool(message.retain))
        if not self._subscriptions.give(came):
            self._say_once("info", f"the broker sends {topic}, which this agent does not listen to any more")


def _not_there(where: str, reason: str) -> str:
    return f"the broker {where} is not there ({reason}); trying until it is"
