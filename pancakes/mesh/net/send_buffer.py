"""What waits for one slow peer: a bounded queue for each channel, and which goes first.

Pure. As long as a link is not congested nothing waits here: its messages go out in the order in which they
were sent. When the peer, or the network, does not keep up:

* `sysctrl` and `network` (migration) go first;
* of `system` the newest waits, for each (source, type, destination): readings grow stale; what waits of one source
  goes together, in the order in which it was published;
* of `log` the oldest fall out;
* every other channel has a window; where it is full the publisher is told so, and nothing is lost in silence;
* the channels take turns.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Collection
from typing import Final

import msgspec

from pancakes.errors import MailboxFull
from pancakes.packet import LOG, NETWORK, SYSCTRL, SYSTEM, Fence

MAX_PACKETS: Final = 1024
"""Most packets of a channel that wait for a peer."""
MAX_BYTES: Final = 4 * 1024 * 1024
"""Most bytes of a channel that wait for a peer. One packet may always wait."""
MIGRATION_BYTES: Final = 40 * 1024 * 1024
"""The same of `network`: the pieces of two of the largest snapshots, or of one that is sent again, and some more."""
MOST_GONE: Final = 1024
"""So many peers that have gone are still known by what went over the links with them."""
FIRST: Final = (SYSCTRL, NETWORK)
"""Channels that are served before all others."""

# Two links with one peer may drop something at once: the one that has just ended, and its successor.
_DROPS: Final = threading.Lock()

Key = tuple[str, str, str]


class PeerBusy(MailboxFull):
    """The window of a (peer, channel) is full: the packet went to no peer, and the publisher may try again."""


class Counters(msgspec.Struct):
    """What went over the links with one peer since this agent was started."""

    packets_out: int = 0
    bytes_out: int = 0
    packets_in: int = 0
    bytes_in: int = 0
    dropped: dict[str, int] = msgspec.field(default_factory=dict)
    """Packets for this peer that were given up, for each channel."""

    def drop(self, channel: str, packets: int = 1) -> None:
        """Counts packets that were given up. From any thread."""
        with _DROPS:
            self.dropped[channel] = self.dropped.get(channel, 0) + packets


class CountersOfAll:
    """The counters of all peers. One that comes back goes on with its own, unless too many have come and gone since."""

    def __init__(self) -> None:
        self._of: dict[str, Counters] = {}  # in the order in which they came, the last at the end

    def __contains__(self, name: str) -> bool:
        return name in self._of

    def of(self, name: str, up: Collection[str]) -> Counters:
        """Returns the counters of a peer.

        Args:
            name: the peer, which comes now.
            up: those that are connected; they are not forgotten.
        """
        counters = self._of[name] = self._of.pop(name) if name in self._of else Counters()
        if len(self._of) > MOST_GONE + len(up) + 1:
            del self._of[next(other for other in self._of if other not in up)]
        return counters

    def forget(self, name: str) -> None:
        """A peer has gone for good."""
        self._of.pop(name, None)


class Message(msgspec.Struct):
    """An encoded packet that waits.

    Attributes:
        data: the packet as a row of a run.
        counts: whether it is a mission packet (a retry is not).
        head: what a run of such packets begins with.
        fence: the right under which it is sent; None: it needs none.
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
        """Adds a packet; `counters` counts what falls out for it.

        Raises:
            PeerBusy: there is no room, and nothing may fall out.
        """
        if self.channel == LOG:
            self._append(message)
            self._make_room(counters)
        elif self._full(len(message.data)):
            raise PeerBusy(f"{peer} is slow: {len(self)} packets ({self.bytes} bytes) on {self.channel} wait for it")
        else:
            self._append(message)

    def pop(self) -> Message:
        """Takes out what is to go next."""
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
        """Whether `more_bytes` are too many (with 0: whether there are too many already)."""
        count = len(self) + (more_bytes > 0)
        return count > MAX_PACKETS or (count > 1 and self.bytes + more_bytes > self._max_bytes)


class _NewestBuffer(_ChannelBuffer):
    """The queue of `system`: the newest of each (source, type, destination).

    Sources take turns, and in its turn a source sends all that waits of it. So neither does a source that publishes
    all the time starve, because its place is always the last, nor does one type of it overtake another.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self._sources: OrderedDict[str, dict[tuple[str, str], Message]] = OrderedDict()
        self._count = 0  # of those that are not on the point of leaving, in `_waiting`

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
        mine[what[0], what[1]] = message  # behind what this source has published since the older one
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
    """All that waits for one peer.

    Args:
        peer: its name, for errors.
        counters: where drops are counted.

    Attributes:
        held_back: the rights of packets that were given up because their right had ended, until that is told.
    """

    def __init__(self, peer: str, counters: Counters) -> None:
        self.peer = peer
        self.counters = counters
        self.held_back: list[Fence] = []
        self._lanes: dict[str, _ChannelBuffer] = {channel: _ChannelBuffer(channel) for channel in FIRST}
        self._turns: deque[_ChannelBuffer] = deque()  # the lanes that have something, except the first ones

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
            lane = self._lanes[channel] = (_NewestBuffer if channel == SYSTEM else _ChannelBuffer)(channel)
        was_empty = not lane
        lane.put(key, message, self.counters, self.peer)
        if was_empty and channel not in FIRST:
            self._turns.append(lane)

    def take(self, limit_bytes: int, may_leave: Callable[[Fence], bool] = lambda fence: True) -> list[Message]:
        """Takes what is to be sent next, at least one message if any waits that may be sent.

        Args:
            limit_bytes: after so many bytes no other is taken.
            may_leave: returns whether what is sent under a right may be sent now; what may not is given up.
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
        """Returns how many packets wait on each channel where any do."""
        return {channel: len(lane) for channel, lane in sorted(self._lanes.items()) if lane}
