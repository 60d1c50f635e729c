"""One connection of the mesh: where a link's messages meet a transport.

`Session` carries what the mesh decides to the connection and back. Packets may be sent from any thread;
all else happens in the transport's thread.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import msgspec

from pancakes.mesh.net.bucket import Bucket
from pancakes.mesh.net.gate import OPEN, Gate
from pancakes.mesh.net.send_buffer import FIRST, Counters, Key, Message, PeerBusy, SendBuffer
from pancakes.mesh.net.transport import Connection, ConnectionHandler
from pancakes.mesh.security.certified import Certified
from pancakes.mesh.wire.codec import Encoder
from pancakes.mesh.wire.framing import frame
from pancakes.mesh.wire.link import Link
from pancakes.mesh.wire.link_messages import Hello, RefuseLink, Timebase
from pancakes.mesh.wire.runs import run_of
from pancakes.packet import Fence

BATCH_BYTES: Final = 16 * 1024
"""How much is handed to a connection at a time when the link is busy. What is urgent waits for no more than that (or
one packet, where that is larger); much smaller, and the system calls would cost more than the packets.
"""
MOST_UNSENT_BYTES: Final = 512 * 1024
"""Where more waits in the connection, the link sends no messages of its own: a peer that sends pings all the time
and takes next to nothing of the answers must not fill the memory.
"""


class Train(msgspec.Struct, gc=False):
    """Packets that one turn of a task has for a peer, or for several: of one type, channel, source and destination.

    Attributes:
        channel: their channel.
        head: what their run begins with.
        sessions: the peers.
        rows: the encoded packets.
        retries: how many of them are no mission packets, because they were sent before.
        fence: the right under which they are sent; None: they need none.
        run: all of them as one message, made when it is first sent.
    """

    channel: str
    head: bytes
    sessions: tuple[Session, ...]
    rows: list[bytes]
    retries: int
    fence: Fence | None
    run: bytes = b""

    def message(self) -> bytes:
        """Returns it as one message of a frame. It must not grow after that."""
        if not self.run:
            self.run = run_of(self.head, self.rows)
        return self.run


class Unwanted(ConnectionHandler):
    """The handler of a connection to an agent that takes none: it only begins, or ends."""

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        connection.close("this agent takes no connections")

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""


class Owner(Protocol):
    """What a session tells the mesh."""

    def session_opened(self, session: Session) -> None:
        """Its connection stands."""

    def session_received(self, session: Session, data: bytes) -> None:
        """Bytes came in."""

    def session_closed(self, session: Session, reason: str) -> None:
        """Its connection is gone."""


class Session(ConnectionHandler):
    """One connection and its link.

    Args:
        owner: the mesh.
        number: the link's number in `Peers`.
        address: what was dialled; empty where the connection came in.
        now: the host clock.
        gate: is asked about what is sent under a right.

    Attributes:
        counted: how many mission packets were sent.
        certified: what the peer's certificate says, also once the link has ended, because what came over it may still
            wait to be looked at; None: the connection has none.
    """

    def __init__(self, owner: Owner, number: int, address: str, now: Callable[[], float], gate: Gate = OPEN) -> None:
        self.number = number
        self.address = address
        self.link: Link | None = None
        self.certified: Certified | None = None
        self.peer = ""
        self.hello: Hello | None = None
        self.is_up = False
        self.due_s = float("inf")  # when the link has something to do, or before that
        self.counters = Counters()
        self.congested = False
        self.counted = 0
        self.reported_drops = 0
        self.reported_s = float("-inf")
        self.told_timebase: Timebase | None = None  # what the peer knows of the clocks of this agent
        self.asked: Bucket | None = None  # how often the peer asked this agent for something lately
        self.refused = 0  # packets that the peer may not send
        self.refused_said_s = float("-inf")
        self._owner = owner
        self._now = now
        self._gate = gate
        self._connection: Connection | None = None
        self._remote = address
        self._lock = threading.Lock()
        self._outbox = SendBuffer("", self.counters)
        self._closed = False
        self._written = 0
        self._taken = (0, 0.0)  # how much the peer had taken when it last took something, and when that was seen
        self._used = (0, 0, 0.0)  # how many packets had come in and gone out when that was last more, and when that was

    @property
    def remote(self) -> str:
        """Address of the other end, for messages to people."""
        return self._remote

    @property
    def role(self) -> str:
        """The peer's role; empty where the link is not up yet."""
        return self.hello.role if self.hello is not None else ""

    def describe(self) -> dict[str, Any]:
        """Returns the state of the link as plain values. From any thread."""
        counters, hello = self.counters, self.hello
        return {
            "name": self.peer,
            "role": self.role,
            "addresses": list(hello.listen) if hello is not None else [],
            "remote": self.remote,
            "certificate": f"{bearer.role} {bearer.name}" if (bearer := self.certified) is not None else "",
            "boot": hello.boot if hello is not None else 0,
            "life": f"{hello.journal}/{hello.boot}" if hello is not None else "",
            "rtt_s": self.link.rtt_s if self.link is not None else None,
            "packets_out": counters.packets_out,
            "packets_in": counters.packets_in,
            "bytes_out": counters.bytes_out,
            "bytes_in": counters.bytes_in,
            "dropped": dict(sorted(counters.dropped.items())),
            "refused": self.refused,
            "waiting": self.waiting(),
        }

    def stood_up(self, hello: Hello, counters: Counters) -> None:
        """The link to the agent that said `hello` is up: from now on packets may be offered."""
        self.hello, self.peer = hello, hello.name
        with self._lock:
            counters.bytes_in += self.counters.bytes_in
            counters.bytes_out += self.counters.bytes_out
            self.counters = counters
            self._outbox.peer, self._outbox.counters = self.peer, counters
            self.reported_drops = sum(counters.dropped.values())
            self.is_up = True

    # The transport's callbacks

    def comes_from(self, remote: str) -> None:
        """See `ConnectionHandler`."""
        self._remote = remote

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        self._connection, self._remote = connection, connection.remote
        self.certified = connection.certified
        self._owner.session_opened(self)

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""
        self.counters.bytes_in += len(data)
        self._owner.session_received(self, data)

    def last_words(self, fault: str) -> bytes:
        """See `ConnectionHandler`."""
        return frame([Encoder().link_message(RefuseLink("name", fault[:1000]))])

    def drained(self) -> None:
        """The connection took all it was given: give it more."""
        with self._lock:
            self._pump()
        self._tell_held_back()

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""
        with self._lock:
            self._closed = True
        self._owner.session_closed(self, reason)

    # Sending

    def send_link(self, message: bytes) -> None:
        """Sends a message of the link itself, before all that waits in the outbox.

        To a peer that takes next to nothing it is not sent; what the peer gets meanwhile is sign of life enough.
        """
        with self._lock:
            if self._unsent() <= MOST_UNSENT_BYTES:
                self._write(frame([message]))

    def send(self, trains: Sequence[Train]) -> None:
        """Sends what one turn has for this peer, at once. From any thread.

        A thread that finds `congested` set must `offer` instead; what it published before goes before what waits.
        """
        with self._lock:
            if self._closed:
                for train in trains:
                    self.counters.drop(train.channel, len(train.rows))
                return
            # As near to the system call as can be: a process may have been stopped since the packets were published.
            going = [train for train in trains if train.fence is None or self._gate.may_leave(train.fence)]
            packets = retries = 0
            for train in going:
                packets += len(train.rows)
                retries += train.retries
            if going:
                data = frame([train.message() for train in sorted(going, key=_comes_after)])
                self._write(data, packets, packets - retries)
        if len(going) < len(trains):
            self._hold_back([train for train in trains if not any(train is other for other in going)])

    def offer(self, channel: str, key: Key, message: Message) -> None:
        """Takes a packet, to be sent when there is room. From any thread.

        Raises:
            PeerBusy: the peer is slow, and the channel's window full.
        """
        with self._lock:
            if self._closed:
                self.counters.drop(channel)
            elif self.congested:
                try:
                    self._outbox.put(channel, key, message)
                except PeerBusy:
                    self.counters.drop(channel)
                    raise
            elif message.fence is None or self._gate.may_leave(message.fence):
                self._write(frame([run_of(message.head, [message.data])]), 1, message.counts)
            else:
                self.counters.drop(channel)
                self._outbox.held_back.append(message.fence)
        self._tell_held_back()

    def end(self, reason: str) -> None:
        """Closes the connection once what it was given is sent."""
        with self._lock:
            self._closed = True
            for channel, packets in self._outbox.waiting().items():
                self.counters.drop(channel, packets)
            # They know each other; so they would stay until garbage is collected, which is seldom.
            connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(reason)

    def stuck_s(self, now_s: float) -> float:
        """Returns for how long the peer has taken none of the bytes that wait for it."""
        if not self._unsent():  # nearly always, and then it needs no lock
            self._taken = (self._written, now_s)
            return 0.0
        with self._lock:
            unsent = self._unsent()
            taken = self._written - unsent
        if unsent == 0 or taken != self._taken[0]:
            self._taken = (taken, now_s)
        return now_s - self._taken[1]

    def quiet_s(self, now_s: float) -> float:
        """Returns for how long no packet has gone either way, as far as that was looked at.

        Infinite for a client of which none came in.
        """
        packets = (self.counters.packets_in, self.counters.packets_out)
        if packets != self._used[:2]:
            self._used = (*packets, now_s)
        return now_s - self._used[2] if self.counters.packets_in or self.role != "client" else math.inf

    def waiting(self) -> dict[str, int]:
        """Returns how many packets wait for this peer, on each channel where any do. From any thread."""
        with self._lock:
            return self._outbox.waiting()

    def _pump(self) -> None:
        self.congested = True  # keeps the order: what is offered now goes behind what waits
        while True:
            messages = self._outbox.take(BATCH_BYTES, self._gate.may_leave)
            if not messages:
                self.congested = False
                return
            self._write(frame(_in_runs(messages)), len(messages), sum(message.counts for message in messages))
            if self._unsent():
                return

    def _hold_back(self, trains: Sequence[Train]) -> None:
        for train in trains:
            assert train.fence is not None
            self.counters.drop(train.channel, len(train.rows))
            self._gate.held_back(train.fence, len(train.rows))

    def _tell_held_back(self) -> None:
        """Tells of what was given up in the outbox. Not under the lock: a line for `log` may come by here."""
        held_back = self._outbox.held_back
        while held_back:
            self._gate.held_back(held_back.pop(), 1)

    def _write(self, data: bytes, packets: int = 0, counted: int = 0) -> None:
        """Writes frames. Under the lock."""
        if self._connection is None:
            return
        if self._connection.send(data):
            self.congested = True
        self._written += len(data)
        self.counters.packets_out += packets
        self.counters.bytes_out += len(data)
        self.counted += counted
        if self.link is not None:
            self.link.sent_s = self._now()

    def _unsent(self) -> int:
        return self._connection.unsent() if self._connection is not None else 0


def _comes_after(train: Train) -> bool:
    return train.channel not in FIRST


def _in_runs(messages: Sequence[Message]) -> list[bytes]:
    """Joins packets that follow each other and have the same head."""
    joined: list[bytes] = []
    rows: list[bytes] = []
    size = 0
    for message, following in zip(messages, (*messages[1:], None), strict=True):
        rows.append(message.data)
        size += len(message.data)
        if following is None or following.head != message.head or size + len(following.data) > BATCH_BYTES:
            joined.append(run_of(message.head, rows))
            rows, size = [], 0
    return joined
