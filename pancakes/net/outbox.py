"""What waits for one slow peer: a bounded queue for each channel, and which goes first.

Pure. As long as a link is not congested nothing waits here: its messages go out in the order in which they
were sent. When the peer, or the network, does not keep up:

* `sysctrl` and `network` (migration) go first;
* of `system` the newest waits, for each (source, type, destination): readings grow stale;
* of `log` the oldest fall out;
* every other channel has a window; where it is full the publisher is told so, and nothing is lost in silence;
* the channels take turns, and blobs (the snapshots of tasks) with them, piece by piece.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final

import msgspec

from pancakes.errors import MailboxFull
from pancakes.packet import LOG, NETWORK, SYSCTRL, SYSTEM
from pancakes.wire.framing import MAX_OPEN_BLOBS

MAX_PACKETS: Final = 1024
"""Most packets of a channel that wait for a peer."""
MAX_BYTES: Final = 4 * 1024 * 1024
"""Most bytes of a channel that wait for a peer. One packet may always wait."""
MIGRATION_BYTES: Final = 40 * 1024 * 1024
"""The same of `network`: the pieces of two of the largest snapshots, or of one that is sent again, and some more."""
FIRST: Final = (SYSCTRL, NETWORK)
"""Channels that are served before all others."""

Key = tuple[str, str, str]


class PeerBusy(MailboxFull):
    """The window of a (peer, channel) is full: the packet was given to nobody, the publisher may try again."""


class Counters(msgspec.Struct):
    """What went over the links with one peer since this agent was started."""

    packets_out: int = 0
    bytes_out: int = 0
    packets_in: int = 0
    bytes_in: int = 0
    dropped: dict[str, int] = msgspec.field(default_factory=dict)
    """Packets for this peer that were given up, for each channel."""

    def drop(self, channel: str, packets: int = 1) -> None:
        """Counts packets that were given up."""
        self.dropped[channel] = self.dropped.get(channel, 0) + packets


class Message(msgspec.Struct):
    """An encoded packet that waits.

    Attributes:
        data: the encoded packet.
        counts: whether it is a mission packet (a retry is not).
    """

    data: bytes
    counts: bool


class _Lane:
    """The queue of one channel."""

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self._max_bytes = MIGRATION_BYTES if channel == NETWORK else MAX_BYTES
        self.waiting: deque[tuple[Key, Message]] = deque()
        self.bytes = 0
        self._newest: dict[Key, Message] = {}

    def put(self, key: Key, message: Message, counters: Counters, peer: str) -> None:
        if self.channel == SYSTEM and (older := self._newest.get(key)) is not None:
            self.bytes += len(message.data) - len(older.data)
            older.data, older.counts = message.data, message.counts  # it keeps its place, so it cannot starve
            counters.drop(self.channel)
        elif self.channel in (SYSTEM, LOG):
            self._append(key, message)
        elif self._full(len(message.data)):
            raise PeerBusy(
                f"{peer} is slow: {len(self.waiting)} packets ({self.bytes} bytes) on {self.channel} wait for it"
            )
        else:
            self._append(key, message)
        while len(self.waiting) > 1 and self._full(0):
            self.pop()
            counters.drop(self.channel)

    def pop(self) -> Message:
        key, message = self.waiting.popleft()
        self.bytes -= len(message.data)
        if self._newest.get(key) is message:
            del self._newest[key]
        return message

    def _append(self, key: Key, message: Message) -> None:
        self.waiting.append((key, message))
        self.bytes += len(message.data)
        if self.channel == SYSTEM:
            self._newest[key] = message

    def _full(self, more_bytes: int) -> bool:
        """Whether `more_bytes` are too many (with 0: whether there are too many already)."""
        count = len(self.waiting) + (more_bytes > 0)
        return count > MAX_PACKETS or (count > 1 and self.bytes + more_bytes > self._max_bytes)


class Outbox:
    """All that waits for one peer.

    Args:
        peer: its name, for errors.
        counters: where drops are counted.
    """

    def __init__(self, peer: str, counters: Counters) -> None:
        self.peer = peer
        self.counters = counters
        self._lanes: dict[str, _Lane] = {channel: _Lane(channel) for channel in FIRST}
        self._turns: deque[_Lane] = deque()  # the lanes that have something, except the first ones
        self._blobs: deque[Iterator[Message]] = deque()
        self._blob_is_next = False

    def put(self, channel: str, key: Key, message: Message) -> None:
        """Adds a packet.

        Args:
            channel: its channel.
            key: its (source, type, destination).
            message: the encoded packet.

        Raises:
            PeerBusy: the channel's window is full.
        """
        lane = self._lanes.get(channel)
        if lane is None:
            lane = self._lanes[channel] = _Lane(channel)
        was_empty = not lane.waiting
        lane.put(key, message, self.counters, self.peer)
        if was_empty and channel not in FIRST:
            self._turns.append(lane)

    def put_blob(self, pieces: Iterator[Message]) -> None:
        """Adds a blob, whose pieces are made when they are sent.

        Raises:
            PeerBusy: as many blobs as may be unfinished wait already.
        """
        if len(self._blobs) >= MAX_OPEN_BLOBS:
            raise PeerBusy(f"{self.peer} is slow: {len(self._blobs)} snapshots wait for it")
        self._blobs.append(pieces)

    def take(self, limit_bytes: int) -> tuple[list[bytes], int]:
        """Takes what is to be sent next, at least one message if any waits.

        Returns:
            The messages, and how many of them are mission packets.
        """
        messages: list[bytes] = []
        size = counted = 0
        while size < limit_bytes:
            message = self._next()
            if message is None:
                break
            messages.append(message.data)
            size += len(message.data)
            counted += message.counts
        return messages, counted

    def _next(self) -> Message | None:
        for channel in FIRST:
            if self._lanes[channel].waiting:
                return self._lanes[channel].pop()
        if self._blobs and (self._blob_is_next or not self._turns):
            self._blob_is_next = False
            piece = next(self._blobs[0], None)
            if piece is not None:
                return piece
            self._blobs.popleft()
            return self._next()
        if not self._turns:
            return None
        self._blob_is_next = True
        lane = self._turns.popleft()
        message = lane.pop()
        if lane.waiting:
            self._turns.append(lane)
        return message

    def waiting(self) -> dict[str, int]:
        """Returns how many packets wait on each channel where any do."""
        return {channel: len(lane.waiting) for channel, lane in sorted(self._lanes.items()) if lane.waiting}
