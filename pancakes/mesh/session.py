"""One connection of the mesh and its send queue: between the link's messages and a transport.

Packets may be sent from any thread; everything else happens in the transport's thread. As long as a link is not
congested, messages leave in the order in which they were sent. If the peer or the network does not keep up, packets
wait in a bounded queue for each channel:

* `sysctrl` and `network` (migration) go first; the other channels take turns;
* `system` keeps only the newest packet of each (source, type, destination);
* `log` drops its oldest packets;
* every other channel has a window: if it is full, the publisher gets `PeerBusy`, and nothing is lost in silence.

A `Gate` is asked right before the system call whether a packet of a guarded task may still leave.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final, NamedTuple, Protocol

import msgspec

from pancakes.errors import MailboxFullError
from pancakes.mesh.admission import Bucket
from pancakes.mesh.codec import encode_link_message, frame, run_of
from pancakes.mesh.link import Link
from pancakes.mesh.messages import Hello, RefuseLink
from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.packet import LOG, NETWORK, SYSCTRL, SYSTEM, Fence
from pancakes.security.roster import Certified
from pancakes.util.timebase import Timebase


class Gate(NamedTuple):
    """Decides about packets of guarded tasks, in the sender's thread, right before the system call.

    Attributes:
        may_leave: returns whether packets with this fence may leave now.
        held_back: takes a fence that is no longer valid, and how many of its packets were dropped.
    """

    may_leave: Callable[[Fence], bool] = lambda fence: True
    held_back: Callable[[Fence, int], None] = lambda fence, packets: None


OPEN: Final = Gate()
"""A gate that lets everything leave."""


MAX_PACKETS: Final = 1024
"""Most packets of a channel that wait for a peer."""
MAX_BYTES: Final = 4 * 1024 * 1024
"""Most bytes of a channel that wait for a peer. One packet may always wait."""
MIGRATION_BYTES: Final = 40 * 1024 * 1024
"""Most bytes of `network` that wait: two of the largest snapshots, or one that is sent again, and some more."""
MOST_GONE: Final = 1024
"""How many disconnected peers keep their counters."""
FIRST: Final = (SYSCTRL, NETWORK)
"""Channels that are served before all others."""

# Two links with one peer may drop packets at the same time: the one that just ended, and its successor.
_DROPS: Final = threading.Lock()

Key = tuple[str, str, str]


class PeerBusy(MailboxFullError):
    """The window of a peer's channel is full: the packet went to no peer, and the publisher may try again."""


class Counters(msgspec.Struct):
    """The traffic with one peer since this agent was started, over all links."""

    packets_out: int = 0
    bytes_out: int = 0
    packets_in: int = 0
    bytes_in: int = 0
    dropped: dict[str, int] = msgspec.field(default_factory=dict)
    """Dropped packets for this peer, by channel."""

    def drop(self, channel: str, packets: int = 1) -> None:
        """Count dropped packets. From any thread."""
        with _DROPS:
            self.dropped[channel] = self.dropped.get(channel, 0) + packets


class PeerCounters:
    """The counters of all peers. A peer that comes back keeps its own, unless too many others have come and gone."""

    def __init__(self) -> None:
        self._of: dict[str, Counters] = {}  # in the order in which they connected, the latest at the end

    def __contains__(self, name: str) -> bool:
        return name in self._of

    def of(self, name: str, up: Collection[str]) -> Counters:
        """Return the counters of a peer.

        Args:
            name: the peer, which connects now.
            up: the connected peers, which are not forgotten.
        """
        counters = self._of[name] = self._of.pop(name) if name in self._of else Counters()
        if len(self._of) > MOST_GONE + len(up) + 1:
            del self._of[next(other for other in self._of if other not in up)]
        return counters

    def forget(self, name: str) -> None:
        """Forget a peer that does not come back."""
        self._of.pop(name, None)


class Message(msgspec.Struct):
    """An encoded packet in a queue.

    Attributes:
        data: the packet as a row of a run.
        counts: whether it is a mission packet (a retry is not).
        head: the head of its run.
        fence: the fence that it needs to leave; None: none.
    """

    data: bytes
    counts: bool
    head: bytes
    fence: Fence | None = None


class _ChannelBuffer:
    """The queue of one channel."""

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self.bytes = 0
        self._max_bytes = MIGRATION_BYTES if channel == NETWORK else MAX_BYTES
        self._waiting: deque[Message] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, key: Key, message: Message, counters: Counters, peer: str) -> None:
        """Add a packet; `counters` counts what is dropped for it.

        Raises:
            PeerBusy: there is no room, and nothing may be dropped.
        """
        if self.channel == LOG:
            self._append(message)
            self._make_room(counters)
        elif self._full(len(message.data)):
            raise PeerBusy(f"{peer} is slow: {len(self)} packets ({self.bytes} bytes) on {self.channel} wait for it")
        else:
            self._append(message)

    def pop(self) -> Message:
        """Remove and return the next packet."""
        message = self._waiting.popleft()
        self.bytes -= len(message.data)
        return message

    def _append(self, message: Message) -> None:
        self._waiting.append(message)
        self.bytes += len(message.data)

    def _make_room(self, counters: Counters) -> None:
        while len(self) > 1 and self._full(0):
            self.pop()
            counters.drop(self.channel)

    def _full(self, more_bytes: int) -> bool:
        """Return whether `more_bytes` would be too many (0: whether there are too many already)."""
        count = len(self) + (more_bytes > 0)
        return count > MAX_PACKETS or (count > 1 and self.bytes + more_bytes > self._max_bytes)


class _NewestBuffer(_ChannelBuffer):
    """The queue of `system`: the newest of each (source, type, destination).

    Sources take turns, and a turn sends all that waits of a source. So a source that publishes all the time does not
    starve, because its place is always the last, and its types do not overtake each other.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self._sources: OrderedDict[str, dict[tuple[str, str], Message]] = OrderedDict()
        self._count = 0  # of the packets in `_waiting` that are not about to leave

    def __len__(self) -> int:
        return len(self._waiting) + self._count

    def put(self, key: Key, message: Message, counters: Counters, peer: str) -> None:
        source, *what = key
        mine = self._sources.setdefault(source, {})
        older = mine.pop((what[0], what[1]), None)
        if older is not None:
            self.bytes -= len(older.data)
            self._count -= 1
            counters.drop(self.channel)
        mine[what[0], what[1]] = message  # after what this source has published since the older one
        self.bytes += len(message.data)
        self._count += 1
        self._make_room(counters)

    def pop(self) -> Message:
        if not self._waiting:
            _, mine = self._sources.popitem(last=False)
            self._waiting.extend(mine.values())
            self._count -= len(mine)
        return super().pop()


class SendBuffer:
    """All queues for one peer.

    Args:
        peer: its name, for errors.
        counters: where drops are counted.

    Attributes:
        held_back: the fences of packets that were dropped because they were no longer valid, until that is logged.
    """

    def __init__(self, peer: str, counters: Counters) -> None:
        self.peer = peer
        self.counters = counters
        self.held_back: list[Fence] = []
        self._lanes: dict[str, _ChannelBuffer] = {channel: _ChannelBuffer(channel) for channel in FIRST}
        self._turns: deque[_ChannelBuffer] = deque()  # the queues with packets, except those served first

    def put(self, channel: str, key: Key, message: Message) -> None:
        """Add a packet.

        Args:
            channel: its channel.
            key: its (source, type, destination).
            message: the encoded packet.

        Raises:
            PeerBusy: the channel's window is full.
        """
        lane = self._lanes.get(channel)
        if lane is None:
            lane = self._lanes[channel] = (_NewestBuffer if channel == SYSTEM else _ChannelBuffer)(channel)
        was_empty = not lane
        lane.put(key, message, self.counters, self.peer)
        if was_empty and channel not in FIRST:
            self._turns.append(lane)

    def take(self, limit_bytes: int, may_leave: Callable[[Fence], bool] = lambda fence: True) -> list[Message]:
        """Take what is sent next: at least one message, if any may be sent.

        Args:
            limit_bytes: after this many bytes no further message is taken.
            may_leave: returns whether packets with a fence may leave now; those that may not are dropped.
        """
        messages: list[Message] = []
        size = 0
        while size < limit_bytes:
            found = self._next()
            if found is None:
                break
            channel, message = found
            if message.fence is not None and not may_leave(message.fence):
                self.counters.drop(channel)
                self.held_back.append(message.fence)
                continue
            messages.append(message)
            size += len(message.head) + len(message.data)
        return messages

    def _next(self) -> tuple[str, Message] | None:
        for channel in FIRST:
            if self._lanes[channel]:
                return channel, self._lanes[channel].pop()
        if not self._turns:
            return None
        lane = self._turns.popleft()
        message = lane.pop()
        if lane:
            self._turns.append(lane)
        return lane.channel, message

    def waiting(self) -> dict[str, int]:
        """Return how many packets wait, by channel; channels with none are left out."""
        return {channel: len(lane) for channel, lane in sorted(self._lanes.items()) if lane}


BATCH_BYTES: Final = 16 * 1024
"""How many bytes are passed to a busy connection at a time. An urgent packet waits for no more than that (or one
packet, if that is larger). With much less, the system calls would cost more than the packets.
"""
MOST_UNSENT_BYTES: Final = 512 * 1024
"""If more bytes wait in the connection, the link sends no messages of its own: a peer that keeps sending pings and
reads almost none of the answers must not fill the memory.
"""


class Train(msgspec.Struct, gc=False):
    """Packets of one turn for one or several peers, with one type, channel, source and destination.

    Attributes:
        channel: their channel.
        head: the head of their run.
        sessions: the peers.
        rows: the encoded packets.
        retries: how many were sent before, and so are not counted as mission packets.
        fence: the fence that they need to leave; None: none.
        run: all of them as one message, made when it is first needed.
    """

    channel: str
    head: bytes
    sessions: tuple[Session, ...]
    rows: list[bytes]
    retries: int
    fence: Fence | None
    run: bytes = b""

    def message(self) -> bytes:
        """Return the packets as one message of a frame. The train must not grow after that."""
        if not self.run:
            self.run = run_of(self.head, self.rows)
        return self.run


class Unwanted(ConnectionHandler):
    """The handler of connections to an agent that accepts none."""

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        connection.close("this agent takes no connections")

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""


class Owner(Protocol):
    """What a session reports to the mesh."""

    def session_opened(self, session: Session) -> None:
        """The connection of a session is open."""

    def session_received(self, session: Session, data: bytes) -> None:
        """Bytes came in."""

    def session_closed(self, session: Session, reason: str) -> None:
        """The connection of a session is gone."""


class Session(ConnectionHandler):
    """One connection and its link.

    Args:
        owner: the mesh.
        number: the link's number in `Peers`.
        address: what was dialled; empty if the connection came in.
        now: the host clock.
        gate: decides about packets with a fence.

    Attributes:
        counted: how many mission packets were sent.
        certified: what the peer's certificate says; None: the connection has none. It is kept after the link has ended,
            because packets that came over it may still wait.
    """

    def __init__(self, owner: Owner, number: int, address: str, now: Callable[[], float], gate: Gate = OPEN) -> None:
        self.number = number
        self.address = address
        self.link: Link | None = None
        self.certified: Certified | None = None
        self.peer = ""
        self.hello: Hello | None = None
        self.is_up = False
        self.due_s = float("inf")  # when the link has something to do, or earlier
        self.counters = Counters()
        self.congested = False
        self.counted = 0
        self.reported_drops = 0
        self.reported_s = float("-inf")
        self.told_timebase: Timebase | None = None  # what the peer knows of the clocks of this agent
        self.asked: Bucket | None = None  # the rate of the peer's requests
        self.refused = 0  # packets that came and that the peer may not send
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
        self._taken = (0, 0.0)  # bytes that the peer had taken when it last took some, and when that was noticed
        self._used = (0, 0, 0.0)  # packets in and out at the last change, and when that was noticed

    @property
    def remote(self) -> str:
        """The address of the other end, for messages to people."""
        return self._remote

    @property
    def role(self) -> str:
        """The peer's role; empty if the link is not up yet."""
        return self.hello.role if self.hello is not None else ""

    def describe(self) -> dict[str, Any]:
        """Return the state of the link as plain values. From any thread."""
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

    def on_link_up(self, hello: Hello, counters: Counters) -> None:
        """Mark the link to the agent that said `hello` as up: from now on packets may be offered."""
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
        return frame([encode_link_message(RefuseLink("name", fault[:1000]))])

    def drained(self) -> None:
        """Give the connection more, as it has taken everything so far."""
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
        """Send a message of the link itself, before all packets in the queues.

        It is not sent to a peer that reads almost nothing: the bytes in the connection are sign of life enough.
        """
        with self._lock:
            if self._unsent() <= MOST_UNSENT_BYTES:
                self._write(frame([message]))

    def send(self, trains: Sequence[Train]) -> None:
        """Send the packets of one turn for this peer at once. From any thread.

        If `congested` is set, call `offer` instead; what this thread published earlier goes before what waits.
        """
        with self._lock:
            if self._closed:
                for train in trains:
                    self.counters.drop(train.channel, len(train.rows))
                return
            # As close to the system call as possible: the process may have been stopped since the packets were
            # published.
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
        """Queue a packet, to be sent when there is room. From any thread.

        Raises:
            PeerBusy: the peer is slow, and the channel's window is full.
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
        """Close the connection once everything in it is sent."""
        with self._lock:
            self._closed = True
            for channel, packets in self._outbox.waiting().items():
                self.counters.drop(channel, packets)
            # They refer to each other, so they would stay in memory until the next garbage collection, which is rare.
            connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(reason)

    def stuck_s(self, now_s: float) -> float:
        """Return for how long the peer has taken none of the waiting bytes."""
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
        """Return for how long no packet has gone either way, as of the last check.

        Infinite for a client that never sent one.
        """
        packets = (self.counters.packets_in, self.counters.packets_out)
        if packets != self._used[:2]:
            self._used = (*packets, now_s)
        return now_s - self._used[2] if self.counters.packets_in or self.role != "client" else math.inf

    def waiting(self) -> dict[str, int]:
        """Return how many packets wait for this peer, by channel. From any thread."""
        with self._lock:
            return self._outbox.waiting()

    def _pump(self) -> None:
        self.congested = True  # keeps the order: packets that are offered now go after those that wait
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
        """Report packets that were dropped in the queues. Not under the lock: the log line may come through here."""
        held_back = self._outbox.held_back
        while held_back:
            self._gate.held_back(held_back.pop(), 1)

    def _write(self, data: bytes, packets: int = 0, counted: int = 0) -> None:
        """Write frames. Under the lock."""
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
    """Join packets that follow each other and have the same head."""
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
